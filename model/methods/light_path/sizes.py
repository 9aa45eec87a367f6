"""Sizes of the textures and of the learned sky, from what pixels see of them."""

import math

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int
from torch import Tensor

from model.methods.light_path.config import MAX_SKY_HEIGHT, SKY_HEIGHT
from model.methods.light_path.pixels import STACKED_VERTICES, LightPathPixels

COUNTED_PIXELS = 4096
"""Random pixels that decide."""

CORNERS = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
"""Three corners of a pixel, as `subpixel_rays` takes them."""

DETAIL = 0.9
"""Share of the pixels that see an object whose footprints are no smaller than a texel (docs/notes/history.md)."""

MOST_TEXELS = 16
"""Limit of all objects' texels together, in squares of `size` for each."""


def measure_sizes(pixels: LightPathPixels, size: int) -> tuple[tuple[int, ...], int]:
    """Widths of the objects' textures, and rows of the sky's finest map, for the training pixels.

    Texels are as small as the footprints of pixels that see the object, directly, mirrored or through glass; only a
    tenth of these footprints may be smaller. Besides, textures have at least about `size` squared texels each, shared
    by how many paths end on an object: at least a third of `size` across, or an eighth where no path ends (glass). On
    proxies, straight hits count, too.
    """
    index = torch.from_numpy(np.random.default_rng(0).integers(len(pixels.rgb), size=COUNTED_PIXELS))
    batch = pixels.take_through(index, CORNERS)
    num_objects, shells, ends, sky = pixels.num_objects, pixels.config.shells, batch.ends, batch.sky
    # The textures of a proxy's shells are as wide as its own.
    objects = (ends.surface.long() - 1) // shells
    met = [objects]
    if pixels.config.straight_layers:
        assert batch.stack is not None
        straight = batch.stack.surface[:, sum(STACKED_VERTICES) :].long()
        met.append((straight[straight > 0] - 1) // shells)
    counts = torch.bincount(torch.cat(met), minlength=num_objects)
    share = counts.double() / counts.sum().clamp_min(1)
    least = torch.where(share > 0, size // 3, size // 8).clamp_min(2)
    place = torch.nn.functional.pad(ends.uv, (0, 1))
    fine = texels_across(ends.ray, objects, place, ends.throughput, num_objects)
    wanted = ((share * num_objects).sqrt() * size).maximum(least).maximum(fine)
    limit = math.sqrt(MOST_TEXELS * num_objects) * size
    wanted = (wanted * min(1.0, limit / float(wanted.norm()))).clamp(2, 2048)
    (per_radian,) = texels_across(sky.ray, torch.zeros_like(sky.ray), sky.direction, sky.throughput, 1).tolist()
    rows = 1 << math.ceil(math.log2(max(1.0, math.pi * per_radian)))
    return tuple(int(width) for width in wanted.round()), max(SKY_HEIGHT, min(MAX_SKY_HEIGHT, rows))


def texels_across(
    ray: Int[Tensor, " end"],
    which: Int[Tensor, " end"],
    place: Float32[Tensor, "end 3"],
    throughput: Float32[Tensor, "end 3"],
    number: int,
) -> Float64[Tensor, " number"]:
    """Texels across a unit of each of `number` objects at which a texel is as large as a small footprint; 0 if unseen.

    A pixel's footprint in an object is the parallelogram of the places where the rays through its corners end there,
    each by the branch that carries most light.
    """
    strongest = np.full((COUNTED_PIXELS * len(CORNERS), number), -1)
    order = torch.argsort(throughput.sum(dim=1), stable=True).numpy()
    # Of equal indices, the last counts: in NumPy, and not in torch, whose threads race.
    strongest[ray.numpy()[order], which.numpy()[order]] = order
    corners = torch.from_numpy(strongest).view(COUNTED_PIXELS, len(CORNERS), number)
    at = place[corners.clamp_min(0)].double()
    areas = torch.linalg.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]).norm(dim=-1)
    across = torch.zeros(number, dtype=torch.float64)
    for one, seen in enumerate((corners >= 0).all(dim=1).T):
        if seen.sum() >= 8:  # With fewer there is nothing to go by.
            across[one] = areas[seen, one].clamp_min(1e-8).rsqrt().quantile(DETAIL)
    return across
