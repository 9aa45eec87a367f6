"""Neural textures as the page holds them: every level as it is, or their sum in bytes."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor

from datagen.data.meshes import Mesh
from model.nets.texture import NeuralTextures, TexturePyramid, level_scales
from model.web.packing import Packed, Quality

Places = list[list[list[int]]]
"""For each texture and level: its first texel, its width, the texels from one of its rows to the next."""


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
    for texture, mesh in enumerate(meshes or ()):
        counts = touched_texels(mesh, sizes[texture])
        # What is never looked up is like what is, and takes no room.
        sums[texture][~counts] = sums[texture][np.argmax(counts)]
    low = np.stack([values.min(axis=0) for values in sums])
    step = np.maximum(np.stack([values.max(axis=0) for values in sums]) - low, 1e-12) / np.float32(255)
    codes: list[UInt8[np.ndarray, "texel c"]] = [
        np.rint((values - low[texture]) / step[texture]).clip(0, 255).astype(np.uint8)
        for texture, values in enumerate(sums)
    ]
    packed.add("texels", np.concatenate(codes))
    packed.add("texelLow", low)
    packed.add("texelStep", step)
    firsts = np.cumsum([0, *(size * size for size in sizes)])
    return [[[int(first), size, size]] for first, size in zip(firsts, sizes)]


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
    row, column = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    uv = torch.stack([(column + 0.5) / size, 1 - (row + 0.5) / size], dim=-1).reshape(-1, 1, 2)
    return textures(uv, torch.full((size * size, 1), texture + 1, dtype=torch.uint8))[:, 0]


def fours(count: int) -> int:
    """The next multiple of 4: textures hold four numbers in each place."""
    return -(-count // 4) * 4


def _padded(features: Tensor) -> Float32[np.ndarray, "texel c"]:
    values = features.cpu().numpy().astype(np.float32)
    return np.pad(values, ((0, 0), (0, fours(values.shape[1]) - values.shape[1])))
