"""Several rays of a pixel: the space in which colours average, and how noisy a mean is."""

import torch
from jaxtyping import Float32
from torch import Tensor


def srgb_curve(linear: Float32[Tensor, "*b"]) -> Float32[Tensor, "*b"]:
    """The sRGB curve, going on below 0 and above 1 so that gradients do. Source: IEC 61966-2-1."""
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


def mean_color(radiance: Float32[Tensor, "pixel sample 3"]) -> Float32[Tensor, "pixel 3"]:
    """sRGB colour of each pixel from the linear radiance of its rays."""
    return srgb_curve(radiance.mean(dim=1))


LEAST_PAIRED = 4
"""Rays of a pixel, in pairs, from which on they tell how noisy their mean is."""


def variance_of_mean(radiance: Float32[Tensor, "pixel sample 3"]) -> Float32[Tensor, "pixel 3"]:
    """Estimated variance of `mean_color` over the choice of rays, of which 2k and 2k + 1 are independent pairs.

    By the slope of the sRGB curve at the mean, through which no gradient flows. 0 where there is but one pair.
    """
    samples = radiance.shape[1]
    if samples < LEAST_PAIRED:
        return torch.zeros_like(radiance[:, 0])
    pairs = radiance[:, : samples // 2 * 2].unflatten(1, (-1, 2)).mean(dim=2)
    mean = radiance.detach().mean(dim=1)
    slope = torch.where(mean <= 0.0031308, 12.92, (1.055 / 2.4) * mean.clamp_min(0.0031308) ** (1 / 2.4 - 1))
    return pairs.var(dim=1) * (2 / samples) * slope.square()


def linear_curve(srgb: Float32[Tensor, "*b"]) -> Float32[Tensor, "*b"]:
    """The inverse of `srgb_curve`."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)
