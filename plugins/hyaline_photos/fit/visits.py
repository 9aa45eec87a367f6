"""How often pictures show each texel of the room and each direction of its sky, and so which pixels to trust."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int
from torch import Tensor

from model.methods.light_path.net import LightPathRenderer
from model.methods.light_path.pixels import LightPathBatch, LightPathPixels
from model.nets.filling import add_visits, filled_layout
from model.nets.learned_sky import LearnedSky
from model.nets.texture import TextureLayout, bilinear_taps

SKY_LEVEL = 1
"""The map of the sky whose texels are counted; in the finest, level 0, noise leaves gaps."""

ENOUGH = 1.0
"""Visits after which a texel counts as half known."""

STEEPNESS = 4
"""Exponent of a pixel's weight. True glass (the bottle of random-7104), drawn through textures that never saw glass,
has a loss of 0.006 where more than 95 % of a pixel's light is known, 0.02 at 85 %, and 0.07 below 60 %."""

COUNTED_BRANCHES = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Visits:
    """Visits by some pixels, in whole pixels (`add_visits`)."""

    layout: TextureLayout
    texels: Float32[Tensor, " texel"]
    """Visits of the room's texels."""
    environment: LearnedSky
    directions: Float32[Tensor, " direction"]
    """Visits of the texels of the sky's map `SKY_LEVEL`."""

    def trust(self, paths: LightPathBatch) -> Float32[Tensor, " pixel"]:
        """Weights of pixels: 1 where all light comes from well-known places, 0 where none does."""
        ends, sky = paths.ends, paths.sky
        texels, shares = bilinear_taps(ends.uv, ends.surface, self.layout)
        at_sky = self.environment.texels_at(SKY_LEVEL, sky.direction)
        visits = torch.cat([(self.texels[texels] * shares).sum(dim=1), self.directions[at_sky]])
        light = torch.cat([ends.throughput, sky.throughput]).mean(dim=1)
        pixel = torch.cat([ends.ray, sky.ray]) // paths.samples
        known, total = (
            torch.zeros(paths.num_pixels).index_add(0, pixel, part)
            for part in (light * visits / (visits + ENOUGH), light)
        )
        return (known / total.clamp_min(1e-6)) ** STEEPNESS


@torch.no_grad()
def count_visits(renderer: LightPathRenderer, pixels: LightPathPixels, rows: Int[np.ndarray, " pixel"]) -> Visits:
    """Counts visits by these pixels, a ray each."""
    config = dataclasses.replace(pixels.config, render_samples=1, branches=COUNTED_BRANCHES)
    single = dataclasses.replace(pixels, config=config)
    layout, environment = filled_layout(renderer.textures), renderer.environment
    texels = torch.zeros(layout.num_texels)
    directions = torch.zeros(environment.maps[SKY_LEVEL][0].numel())
    for part in torch.from_numpy(rows).split(single.chunk):
        paths = single.take(part, None)
        add_visits(texels, layout, paths.ends.uv, paths.ends.surface, paths.ends.throughput.mean(dim=1))
        at_sky = environment.texels_at(SKY_LEVEL, paths.sky.direction)
        directions.index_add_(0, at_sky, paths.sky.throughput.mean(dim=1).square())
    return Visits(layout=layout, texels=texels, environment=environment, directions=directions)
