"""Pixels whose rays differ, drawn anew with more rays: rough metal, edges, glass in front of detail."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from model.batches.samples import mean_color, srgb_curve
from model.methods.light_path.paths import LightPathBatch
from model.methods.light_path.pixels import LightPathPixels

MOST_DOUBT = 4 / 255
"""Standard error of a pixel's sRGB colour beyond which it is drawn anew. Measured on the glass table (1/32 of the test
pixels, a briefly trained renderer): 64 rays for all pixels gain 0.53 / 0.33 dB on the test splits; for these, a seventh
of all, 0.46 / 0.22 dB. At 2 / 255 it would be 0.48 / 0.27 dB for three tenths."""

ROUND_NUMBER = 256
"""Pixels drawn anew are filled up to a multiple of this: a tracer records a kernel for each number of rays."""


def draw_refined(
    radiance_of: Callable[[LightPathBatch], Float32[Tensor, "pixel sample 3"]], pixels: LightPathPixels
) -> Float32[Tensor, "pixel 3"]:
    """sRGB colours of all pixels, those whose rays differ by `refined_samples` rays instead of `render_samples`."""
    config = pixels.config
    parts, doubts = [], []
    for part in torch.arange(len(pixels.rgb)).split(pixels.chunk):
        radiance = radiance_of(pixels.take(part, None))
        parts.append(srgb_curve(radiance.mean(dim=1)))
        doubts.append(is_doubtful(radiance))
    colors = torch.cat(parts)
    again = torch.cat(doubts).nonzero().flatten().cpu()
    # Dr.Jit 1.5 aborts the process where it traces no ray; and a tensor of nothing splits into one part, of nothing.
    if config.refined_samples <= config.render_samples or not len(again):
        return colors
    finer = pixels.refined()
    for part in again.split(finer.chunk):
        filled = torch.cat([part, part[:1].expand(-len(part) % ROUND_NUMBER)])
        colors[part] = mean_color(radiance_of(finer.take(filled, None)))[: len(part)]
    return colors


def is_doubtful(radiance: Float32[Tensor, "pixel sample 3"]) -> Bool[Tensor, " pixel"]:
    """True where the mean over a pixel's rays may be off by more than `MOST_DOUBT` in any channel."""
    if radiance.shape[1] == 1:
        return torch.zeros(len(radiance), dtype=torch.bool, device=radiance.device)
    mean = radiance.mean(dim=1)
    error = radiance.std(dim=1) / radiance.shape[1] ** 0.5
    # White is white, however bright.
    most, least = (srgb_curve(value.clamp_min(0)).clamp_max(1) for value in (mean + error, mean - error))
    return ((most - least) / 2 > MOST_DOUBT).any(dim=1)
