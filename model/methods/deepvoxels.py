"""Owns the method `deepvoxels`: a grid of learned features that views are lifted into and drawn from.

Source: Sitzmann et al., DeepVoxels: Learning Persistent 3D Feature Embeddings, CVPR 2019, and the code they released;
in this paper section 5.1. No geometry is known: the method gets images, cameras and how far the scene reaches.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from model.batches.view_batches import ViewBatch
from model.nets.voxel_blocks import Unet
from model.nets.voxel_grid import ViewCamera, VoxelGrid, fit_cube, lift, sample_frustum
from model.nets.voxel_nets import (
    Critic,
    Integration,
    Occlusion,
    Volume,
    collapse,
    feature_extractor,
    rendering_network,
)
from model.settings.choices import DeepVoxelsChoices


@dataclass(frozen=True, kw_only=True)
class DeepVoxelsConfig:
    """What DeepVoxels is made of; the defaults are its authors'."""

    image_size: int
    """Width and height of the pictures: a power of two. Theirs are 512; from 128 on the networks have their form."""
    num_voxels: int = 32
    """Along each edge of the grid."""
    plane_size: int = 64
    """Width and height on which features are lifted and projected: a power of two, at most the pictures' size. Each
    halving from the pictures to it is a stage of the feature extractor, and one of the rendering network."""
    voxel_features: int = 64
    width: int = 64
    """Channels of the outermost 2-D convolutions; the deepest have eight times as many."""
    dropout: float = 0.1
    """Share of channels dropped in the rendering network; the integration drops twice as many."""
    bounded: bool = False
    """The integration's candidate is a tanh, as in other gated units, instead of the authors' ReLU. With ReLU nothing
    bounds the grid: norms behind it hide its scale from the loss, and Adam may push the unit's gain above 1. Measured
    at a rate of 0.002: it grew 3.5 times a step, new views were lost in it after 20 steps, it overflowed after 80."""
    adversarial: bool = False
    """Adds the authors' patch discriminator to the loss; the paper had to leave it out (section 5.1)."""

    def __post_init__(self) -> None:
        for name, low in (("image_size", 64 if self.adversarial else 16), ("plane_size", 16), ("num_voxels", 4)):
            value = getattr(self, name)
            if value < low or value & (value - 1):
                raise HyalineError(f"{name}: is {value}; deepvoxels needs a power of two of {low} or more")
        if self.plane_size > self.image_size:
            raise HyalineError(f"plane_size: is {self.plane_size}; expected at most the pictures' {self.image_size}")
        if not 0 <= self.dropout < 0.5:
            raise HyalineError(f"dropout: is {self.dropout}; expected a share from 0 to below 0.5")
        if self.width < 2 or self.voxel_features < 1:
            raise HyalineError(f"width: is {self.width} with {self.voxel_features} features; expected 2 and 1 or more")


Preset = Literal["small", "paper", "original"]


@dataclass(frozen=True, kw_only=True)
class PresetChoice:
    """A named setting: what is built, for pictures of the authors' size, and how it is trained."""

    net: DeepVoxelsConfig
    lr: float
    lr_decay: Literal["none", "linear"]


PRESETS: dict[Preset, PresetChoice] = {
    # For machines without a GPU: a fourteenth of the parameters, fewer rays, a rate for few steps that a bounded grid
    # stands, and no dropout: of so few channels none is spare.
    "small": PresetChoice(
        net=DeepVoxelsConfig(
            image_size=512, plane_size=32, width=16, voxel_features=32, dropout=0.0, bounded=True, adversarial=False
        ),
        lr=2e-3,
        lr_decay="linear",
    ),
    # Section 5.1: "disabling adversarial loss and only training on L1 loss with a low learning rate (1e-5)".
    "paper": PresetChoice(net=DeepVoxelsConfig(image_size=512, adversarial=False), lr=1e-5, lr_decay="none"),
    "original": PresetChoice(net=DeepVoxelsConfig(image_size=512, adversarial=True), lr=4e-4, lr_decay="none"),
}


def preset_deepvoxels(preset: Preset, resolution: int) -> DeepVoxelsConfig:
    """The configuration of a preset for pictures of some size.

    Raises:
        HyalineError: the size is no power of two.
    """
    choice = PRESETS[preset]
    if resolution & (resolution - 1):
        raise HyalineError(
            f"resolution: is {resolution}; deepvoxels needs a power of two, "
            f"so build the dataset with --resolution {2 ** round(math.log2(resolution))}"
        )
    return dataclasses.replace(choice.net, image_size=resolution, plane_size=min(choice.net.plane_size, resolution))


def preset_of(choices: DeepVoxelsChoices) -> Preset:
    """The preset that a user chose, or what suits the machine."""
    return choices.voxels or ("paper" if torch.cuda.is_available() else "small")


def configure_deepvoxels(
    choices: DeepVoxelsChoices,
    dataset: Dataset,
    geometry: str,  # noqa: ARG001
    num_layers: int,  # noqa: ARG001
) -> DeepVoxelsConfig:
    """The configuration that a user's choices make on a dataset.

    Raises:
        HyalineError: pictures whose size is no power of two.
    """
    return preset_deepvoxels(preset_of(choices), dataset.config.resolution)


class DeepVoxels(nn.Module):
    """Views in, their pictures out, drawn from a grid of features that training views were lifted into.

    The grid is a buffer, no parameter: each training step integrates one more view into it, without a gradient to the
    steps before, and it lasts for the run.
    """

    def __init__(self, config: DeepVoxelsConfig, *, origin: Float32[Tensor, "3"], edge: float) -> None:
        """Args:
        origin: of the grid, in world space, metres.
        edge: of the grid, metres.
        """
        super().__init__()
        self.config = config
        features, size = config.voxel_features, config.num_voxels
        num_halvings = int(math.log2(config.image_size // config.plane_size))
        plane = config.plane_size
        self.feature_extractor = feature_extractor(
            width=config.width, num_outputs=features, num_halvings=num_halvings, plane_size=plane
        )
        self.integration = Integration(features, dropout=2 * config.dropout, bounded=config.bounded)
        self.inpainting = Unet(3, features + 3, features, width=features, num_down=2, max_channels=4 * features)
        self.occlusion = Occlusion(features, num_planes=2 * size, plane_size=plane)
        self.rendering = rendering_network(
            width=config.width,
            num_inputs=features,
            num_doublings=num_halvings,
            plane_size=plane,
            dropout=config.dropout,
        )
        self.critic = Critic() if config.adversarial else None
        # Saved with the weights: what is drawn later must stand where it was learned.
        self.register_buffer("origin", origin.clone())
        self.register_buffer("voxel_size", torch.tensor(edge / size, dtype=torch.float32))
        self.register_buffer("volume", torch.zeros(1, features, size, size, size))
        self.register_buffer("coordinates", grid_coordinates(size), persistent=False)

    @property
    def grid(self) -> VoxelGrid:
        """Where the voxels are."""
        origin, voxel_size = self.get_buffer("origin"), self.get_buffer("voxel_size")
        return VoxelGrid(origin=origin, voxel_size=voxel_size, num_voxels=self.config.num_voxels)

    def forward(self, views: ViewBatch) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours in [0, 1] of all pixels of the views, drawn from the grid as it is."""
        inpainted = self.inpaint(self.get_buffer("volume"))
        return torch.cat([self.draw(inpainted, camera)[0].flatten(1).T for camera in views.cameras])

    def observe(self, image: Float32[Tensor, "1 3 h w"], camera: ViewCamera) -> Volume:
        """The grid after one more view, which it then keeps.

        Args:
            image: sRGB in [0, 1].
        """
        lifted = lift(self.feature_extractor(image - 0.5), camera, self.grid)
        volume = self.integration(lifted, self.get_buffer("volume"), self.get_buffer("coordinates"))
        # A new tensor: this step's gradient still needs the old one.
        self.volume = volume.detach()
        return volume

    def inpaint(self, volume: Volume) -> Volume:
        """The grid with what no view has shown filled in from around."""
        return self.inpainting(torch.cat([volume, self.get_buffer("coordinates")], dim=1))

    def draw(self, inpainted: Volume, camera: ViewCamera) -> Float32[Tensor, "1 3 h w"]:
        """sRGB picture in [0, 1] of one view."""
        frustum = sample_frustum(inpainted, camera, self.grid, self.config.plane_size)
        return 0.5 + 0.5 * self.rendering(collapse(frustum, self.occlusion(frustum)))


def grid_coordinates(size: int) -> Float32[Tensor, "1 3 z y x"]:
    """The place of each voxel along z, y and x, in [-0.5, 0.5)."""
    steps = torch.arange(-(size // 2), size // 2) / size
    return torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"))[None]


def build_deepvoxels(config: DeepVoxelsConfig, dataset: Dataset, geometry: str, num_layers: int) -> DeepVoxels:  # noqa: ARG001
    """A fresh network for a dataset, its grid around what the training cameras look at.

    Raises:
        HyalineError: pictures of another size, or cameras that do not surround anything.
    """
    if dataset.config.resolution != config.image_size:
        raise HyalineError(
            f"image_size: is {config.image_size}, but {dataset.root} has {dataset.config.resolution} pixels; "
            "expected pictures of the size that the networks were made for"
        )
    vertices = np.concatenate([mesh.vertices for mesh in read_meshes(dataset, TRUTH)]).astype(np.float64)
    origin, edge = fit_cube(dataset.cameras("train"), vertices)
    return DeepVoxels(config, origin=torch.from_numpy(origin).float(), edge=edge)
