"""Textures as the page holds them: neural ones, every level as it is or their sum in steps; and those of metals."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from datagen.data.images import srgb_from_linear, to_8bit
from datagen.data.meshes import Mesh
from datagen.trace.tints import Texels, Tints
from model.methods.page import fours
from model.nets.texture import NeuralTextures, TexturePyramid, level_scales, texel_centers
from model.web.packing import Packed, Quality, residuals, zigzag

STEPS = 16
"""In which a small page stores a standard deviation of texels: it costs a page of the demo 0.4 to 1.4 dB to Python."""

MAX_CODE = 8191
"""So that the difference of two fits into 16 bits."""

Places = list[list[list[int]]]
"""For each texture and level: its first texel, its width, the texels from one of its rows to the next."""

TintPlaces = list[list[int] | None]
"""For each object the first of its texels, and how many columns and rows they have; None where one colour says all."""


def add_texels(
    packed: Packed, textures: NeuralTextures | TexturePyramid, quality: Quality, meshes: Sequence[Mesh] | None
) -> Places:
    """Adds the texels of all levels; small: their sum at the finest level's texels.

    Args:
        meshes: of each texture; only texels that a look-up on it can touch count. None: all count.
    """
    levels = textures.levels() if isinstance(textures, TexturePyramid) else [textures]
    layouts = [level.layout for level in levels]
    if quality == "exact":
        finer_counts = textures.finer_counts if isinstance(textures, TexturePyramid) else 1.0
        scales = level_scales(len(levels), finer_counts)
        tables = [_padded(scale * level.table) for scale, level in zip(scales, levels)]
        packed.add("texels", np.concatenate(tables))
        firsts = np.cumsum([0, *(len(table) for table in tables)])
        return [
            [
                [int(first) + layout.bases[texture], layout.sizes[texture], layout.strides[texture]]
                for first, layout in zip(firsts, layouts)
            ]
            for texture in range(len(layouts[0].sizes))
        ]
    sizes = layouts[0].sizes
    sums = [_padded(_summed(textures, texture, size)) for texture, size in enumerate(sizes)]
    counts = [np.ones(len(values), bool) for values in sums]
    for texture, mesh in enumerate(meshes or ()):
        counts[texture] = touched_texels(mesh, sizes[texture])
    step = _step(np.concatenate([values[chosen] for values, chosen in zip(sums, counts)]), levels[0].table.shape[1])
    codes = [
        residuals(
            np.rint(values / step).astype(np.int32).reshape(size, size, -1).clip(-MAX_CODE, MAX_CODE),
            chosen.reshape(size, size),
        ).reshape(size * size, -1)
        for values, size, chosen in zip(sums, sizes, counts)
    ]
    packed.add("texels", zigzag(np.concatenate(codes)).astype(np.uint16))
    packed.add("texelStep", np.array([step], np.float32))
    firsts = np.cumsum([0, *(size * size for size in sizes)])
    return [[[int(first), size, size]] for first, size in zip(firsts, sizes)]


def _step(values: Float32[np.ndarray, "texel c"], channels: int) -> float:
    """The step in which texels are stored, for a spread of all channels that are not there to fill up."""
    spread = float(np.sqrt(values[:, :channels].var(axis=0).mean())) if len(values) else 0.0
    return max(spread / STEPS, float(np.abs(values).max(initial=0)) / MAX_CODE, 1e-9)


def touched_texels(mesh: Mesh, size: int) -> Bool[np.ndarray, " texel"]:
    """Which texels bilinear look-ups on a mesh can touch, row by row; perhaps some more."""
    touched = np.zeros((size + 2, size + 2), bool)
    corners = mesh.uv[mesh.faces].astype(np.float64) * [1, -1] + [0, 1]
    extent = size * np.ptp(corners, axis=1).max(axis=-1, initial=0)
    # Points on each face, no more than half a texel from each other, in as many steps as some power of 2.
    steps = 1 << np.ceil(np.log2(np.maximum(2 * extent, 1))).astype(int)
    for count in np.unique(steps):
        first, second = (share.ravel() / count for share in np.mgrid[: count + 1, : count + 1])
        inside = first + second <= 1
        shares = np.stack([1 - first - second, first, second], axis=1)[inside]
        chosen = corners[steps == count]
        for part in np.array_split(chosen, -(-len(chosen) * len(shares) // 1_000_000)):
            places = np.clip(np.floor(np.einsum("pk,fkc->fpc", shares, part) * size), 0, size - 1).astype(int) + 1
            touched[places[..., 1], places[..., 0]] = True
    wider = np.zeros_like(touched)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            wider |= np.roll(touched, (down, right), axis=(0, 1))
    return wider[1:-1, 1:-1].ravel()


def _summed(textures: NeuralTextures | TexturePyramid, texture: int, size: int) -> Tensor:
    """The features of a texture (counted from 0) at the centres of its finest texels."""
    object_id = torch.full((size * size, 1), texture + 1, dtype=torch.uint8)
    return textures(texel_centers(size)[:, None], object_id)[:, 0]


def _padded(features: Tensor) -> Float32[np.ndarray, "texel c"]:
    values = features.cpu().numpy().astype(np.float32)
    return np.pad(values, ((0, 0), (0, fours(values.shape[1]) - values.shape[1])))


def add_tints(packed: Packed, tints: Tints, quality: Quality) -> TintPlaces:
    """Adds the texels of all metals that have any, row by row: linear floats; small: 8 bits of sRGB, as images have."""
    images: dict[bytes, tuple[int, Texels]] = {}
    places: TintPlaces = []
    count = 0
    for texels in tints:
        if texels is None:
            places.append(None)
            continue
        height, width, _ = texels.shape
        key = b"%d %d " % (height, width) + texels.tobytes()
        if key not in images:
            images[key] = (count, texels)
            count += height * width
        places.append([images[key][0], width, height])
    if images:
        linear = np.concatenate([texels.reshape(-1, 3) for _, texels in images.values()])
        if quality == "small":
            packed.add("tints", to_8bit(srgb_from_linear(linear)), differences=True)
        else:
            packed.add("tints", linear)
    return places
