"""In-painting: on poses without ground truth, texels that no training ray visits learn to look real.

Source: the paper's proposal for surfaces never seen in training (section 6), with the discriminator on views without
ground truth from DeepVoxels.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor, nn
from torch.func import functional_call

from datagen.data.cameras import Cameras, look_at
from datagen.data.config import Resolution
from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.disk.errors import HyalineError
from model.batches.layers import trace_layers
from model.batches.rays import PixelSource, RayBatch
from model.nets.texture import NeuralTextures, bilinear_taps

NUM_POSES = 64
"""Number of poses without ground truth for in-painting."""

DISTANCES, HEIGHTS = (0.4, 1.2), (0.1, 1.0)
"""Distance and height over the rig's target, relative to those of random training cameras."""

AIM = 0.25
"""Largest offset of the look-at point from the target, relative to the camera's distance."""


class Inpainter:
    """Renders patches of poses without ground truth; gradients reach only unvisited texels."""

    def __init__(
        self,
        renderer: nn.Module,
        training: PixelSource[RayBatch],
        dataset: Dataset,
        geometry: str,
        *,
        num_layers: int,
        seed: int,
        device: torch.device,
    ) -> None:
        """Counts the texel visits of all training rays, and finds pixels that show an unvisited texel."""
        self.visits = {
            f"{name}.table": count_visits(module, training)
            for name, module in renderer.named_modules()
            if isinstance(module, NeuralTextures)
        }
        cameras = novel_cameras(dataset, NUM_POSES, np.random.default_rng([seed, 1]))
        self.pixels = trace_layers(read_meshes(dataset, geometry), cameras, num_layers).to(device)
        finest = next(module for module in renderer.modules() if isinstance(module, NeuralTextures))
        self.showing = pixels_showing(finest, next(iter(self.visits.values())) == 0, self.pixels).nonzero().flatten()
        if not len(self.showing):
            raise HyalineError(f"{dataset.root}: training rays visit every visible texel; leave out --inpaint")

    def render(self, renderer: nn.Module, number: int, size: int, rng: np.random.Generator) -> Tensor:
        """Colours (patch, row, column, 3) of patches around pixels that show an unvisited texel.

        The network and all visited texels are constants, and batch norm uses its running statistics.
        """
        index = patches_around(
            self.showing[torch.from_numpy(rng.integers(len(self.showing), size=number))], size, self.pixels.resolution
        )
        parameters = {name: value.detach() for name, value in renderer.named_parameters()}
        for name, visits in self.visits.items():
            table = renderer.get_parameter(name)
            parameters[name] = torch.where(visits[:, None] > 0, table.detach(), table)
        renderer.eval()
        colors = functional_call(renderer, parameters, (self.pixels.take(index, None),))
        renderer.train()
        return colors.view(number, size, size, 3)


def count_visits(textures: NeuralTextures, pixels: PixelSource[RayBatch]) -> Int[Tensor, " texel"]:
    """The number of layers on the pixels' centre rays that sample each texel with any weight."""
    counts = torch.zeros(textures.layout.num_texels, dtype=torch.int64, device=pixels.device)
    for rays in _chunks(pixels):
        hit = rays.object_id != 0
        texels, weights = bilinear_taps(rays.uv[hit], rays.object_id[hit], textures.layout)
        counts += torch.bincount(texels[weights > 0], minlength=len(counts))
    return counts


def pixels_showing(
    textures: NeuralTextures, wanted: Bool[Tensor, " texel"], pixels: PixelSource[RayBatch]
) -> Bool[Tensor, " pixel"]:
    """The pixels with a layer whose look-up takes at least half of its weight from wanted texels."""
    found = []
    for rays in _chunks(pixels):
        hit = rays.object_id != 0
        texels, weights = bilinear_taps(rays.uv[hit], rays.object_id[hit], textures.layout)
        is_wanted = torch.zeros(hit.shape, dtype=torch.bool, device=hit.device)
        is_wanted[hit] = (weights * wanted[texels]).sum(dim=1) >= 0.5
        found.append(is_wanted.any(dim=1))
    return torch.cat(found)


def patches_around(pixel: Int[Tensor, " patch"], size: int, resolution: Resolution) -> Int[Tensor, "patch row column"]:
    """Row numbers of the square patches around these pixels, moved inwards at a view's border."""
    height, width = resolution.shape
    view, row, column = pixel // resolution.pixels, pixel // width % height, pixel % width
    first_row, first_column = (
        (place - size // 2).clamp(0, side - size) for place, side in ((row, height), (column, width))
    )
    steps = torch.arange(size, device=pixel.device)
    rows, columns = first_row[:, None, None] + steps[:, None], first_column[:, None, None] + steps
    return (view[:, None, None] * height + rows) * width + columns


def novel_cameras(dataset: Dataset, number: int, rng: np.random.Generator) -> Cameras:
    """Poses around the training cameras, but nearer, farther and lower; test cameras are not used."""
    from datagen.scene.folder import open_scene  # Not before: training without in-painting needs no scene.

    cameras = dataset.cameras("train")
    target = np.array(open_scene(dataset).cameras.target)
    offset = cameras.world_from_camera[rng.integers(len(cameras.world_from_camera), size=number), :3, 3] - target
    offset = offset * rng.uniform(*DISTANCES, (number, 1))
    offset[:, 2] *= rng.uniform(*HEIGHTS, number)
    aims = target + AIM * np.linalg.norm(offset, axis=1, keepdims=True) * rng.uniform(-1, 1, (number, 3))
    poses = [look_at(position, aim) for position, aim in zip(target + offset, aims, strict=True)]
    return dataclasses.replace(cameras, world_from_camera=np.stack(poses))


def _chunks(pixels: PixelSource[RayBatch]) -> Iterator[RayBatch]:
    index = torch.arange(len(pixels.rgb), device=pixels.rgb.device)
    for part in index.split(pixels.chunk):
        yield pixels.take(part, None)
