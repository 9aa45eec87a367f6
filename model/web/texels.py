"""Neural textures as the page holds them: every level as it is, or their sum in bytes."""

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from model.nets.texture import NeuralTextures, TexturePyramid, level_scales
from model.web.packing import Packed, Quality

Places = list[list[list[int]]]
"""For each texture and level: its first texel, its width, the texels from one of its rows to the next."""


def add_texels(packed: Packed, textures: NeuralTextures | TexturePyramid, quality: Quality) -> Places:
    """Adds the texels of all levels; small: their sum at the finest level's texels."""
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
