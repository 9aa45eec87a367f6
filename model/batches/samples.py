"""Owns what several rays of a pixel have in common: how many there may be, and the space in which colours average."""

import math

import torch
from jaxtyping import Float32
from torch import Tensor

from datagen.disk.errors import HyalineError


def check_samples(name: str, samples: int) -> None:
    """Raises a HyalineError where a pixel cannot be tiled by a square grid of so many cells."""
    if samples < 1 or math.isqrt(samples) ** 2 != samples:
        raise HyalineError(f"{name}: is {samples}; expected a square number of rays per pixel")


def srgb_curve(linear: Float32[Tensor, "*b"]) -> Float32[Tensor, "*b"]:
    """The sRGB curve, going on below 0 and above 1 so that gradients do. Source: IEC 61966-2-1."""
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


def linear_curve(srgb: Float32[Tensor, "*b"]) -> Float32[Tensor, "*b"]:
    """The inverse of `srgb_curve`."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)
