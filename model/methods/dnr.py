"""Owns the methods `dnr` and `dnr-layers`: Deferred Neural Rendering, on the first layer alone and on all of them."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from model.batches.rays import PixelSource, RayBatch, draw_patches, side_of, take_colors
from model.losses.pixel_losses import PatchTerms
from model.methods.paper import default_texture_size
from model.nets.extrinsics import ExtrinsicInputs, Extrinsics, positions_for
from model.nets.texture import TexturePyramid, object_layout
from model.nets.unet import UNet, UNetNorm
from model.settings.choices import DnrChoices

LEVEL_WEIGHTS = (8.0, 2.0, 1.0, 0.0)
"""How strongly each level of the textures is held near zero, finest first: detail goes where it is needed only."""

LEAST_CROP = 128
"""Height and width in pixels of the smallest training crops that a picture's size asks for."""

SH_CHANNELS = slice(3, 12)
"""The texture channels that the nine spherical harmonics of the view vector multiply."""


@dataclass(frozen=True, kw_only=True)
class DnrConfig:
    """What the deferred neural renderer is made of. Defaults: Thies et al. 2019 (arXiv 1904.12356) as it is known from
    its first author's public code, with the transparent paper's 16 features."""

    texture_size: int
    """Width and height of an object's finest texture in texels."""
    texture_levels: int = 4
    """Textures summed, each half as wide as the one before."""
    texture_features: int = 16
    extrinsics: Extrinsics = "sh"
    """`sh` multiplies nine features by spherical harmonics, for each pixel; `view` adds the view vector as inputs."""
    position_size: int = 512
    """Width and height of the position textures that view vectors come from, in texels."""
    unet_width: int = 64
    """Channels of the network's first level."""
    norm: UNetNorm = "instance"
    crop: int = 0
    """Height and width of training crops in pixels; 0: whole pictures."""
    strides: tuple[int, ...] = (1, 2)
    """Random scales of the crops: every pixel or every second one. uv is never interpolated, because neighbours across
    a seam do not mix; so pictures are made smaller only, and their colours are those of the pixels kept."""
    texture_color: float = 1.0
    """Weight of the difference between the first three texture channels and the picture, beside that of the output."""
    regularisation: float = 0.1
    """Weight of the mean squares of the texels, itself weighted by level."""

    def __post_init__(self) -> None:
        if not 2 <= self.texture_size <= 8192:
            raise HyalineError(f"texture_size: is {self.texture_size}; expected 2 to 8192 texels")
        if not 1 <= self.texture_levels <= len(LEVEL_WEIGHTS):
            raise HyalineError(f"texture_levels: is {self.texture_levels}; expected 1 to {len(LEVEL_WEIGHTS)}")
        least = SH_CHANNELS.stop if self.extrinsics == "sh" else 3
        if not least <= self.texture_features <= 256:
            raise HyalineError(
                f"features: is {self.texture_features} with extrinsics {self.extrinsics}; expected {least} to 256"
            )
        if self.unet_width < 1:
            raise HyalineError(f"unet_width: is {self.unet_width}; expected at least 1, 64 in the paper")
        if self.crop < 0 or min(self.strides, default=0) < 1:
            raise HyalineError(f"crop: is {self.crop} with strides {self.strides}; expected 0 or more, and 1 or more")


def configure_dnr(choices: DnrChoices, dataset: Dataset, geometry: str, num_layers: int) -> DnrConfig:  # noqa: ARG001
    """The configuration that a user's choices make on a dataset.

    Textures are as wide as those of `paper`: half the picture's width for each object, so that the methods differ in
    what they do and not in their texels. Crops are half the picture wide (256 pixels of 512 are common), but of 128
    pixels at least: a narrower one leaves the U-Net's innermost level nothing but its border, which a whole picture is
    not (measured on the glass table at 128 pixels: crops of 64 cost 3 dB on both splits).

    Raises:
        HyalineError: a choice that cannot be.
    """
    resolution = dataset.config.resolution
    config = DnrConfig(
        texture_size=choices.texture_size or default_texture_size(resolution, len(dataset.objects), "object"),
        unet_width=choices.unet_width,
        crop=min(resolution, max(resolution // 2, LEAST_CROP)),
    )
    if choices.preset == "authors":
        config = dataclasses.replace(
            config, texture_levels=1, texture_features=8, extrinsics="view", norm="batch", crop=0, strides=(1,),
            texture_color=0.0, regularisation=0.0,
        )  # fmt: skip
    given = {
        "texture_features": choices.features,
        "texture_levels": choices.texture_levels,
        "extrinsics": choices.extrinsics,
        "crop": choices.crop,
    }
    config = dataclasses.replace(config, **{name: value for name, value in given.items() if value is not None})
    if config.crop > resolution:
        raise HyalineError(f"crop: is {config.crop}; expected at most the picture's {resolution} pixels")
    return config


class DnrRenderer(nn.Module):
    """Patches of rays with layers in, sRGB colours of their pixels out."""

    def __init__(
        self, config: DnrConfig, *, num_layers: int, num_objects: int, positions: Float32[Tensor, "texel 3"] | None
    ) -> None:
        super().__init__()
        self.config = config
        self.textures = TexturePyramid(
            [
                object_layout((max(2, config.texture_size >> level),) * num_objects)
                for level in range(config.texture_levels)
            ],
            config.texture_features,
        )
        self.extrinsics = (
            None
            if positions is None
            else ExtrinsicInputs(config.extrinsics, positions, num_objects=num_objects, size=config.position_size)
        )
        channels = config.texture_features + (3 if config.extrinsics == "view" else 0)
        self.net = UNet(num_layers * channels, width=config.unet_width, norm=config.norm)

    def forward(self, rays: RayBatch, **_: object) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours in (0, 1) of the pixels, which form patches or whole pictures (`rays.grid`)."""
        return self.shade(rays)[0]

    def shade(self, rays: RayBatch) -> tuple[Float32[Tensor, "pixel 3"], Float32[Tensor, "pixel 3"]]:
        """sRGB colours of the pixels, and what the first layer's first three features would make alone."""
        assert rays.grid is not None, "a U-Net needs to know which pixels are neighbours"
        features = self.textures(rays.uv, rays.object_id)
        diffuse = features[:, 0, :3]
        if self.extrinsics is not None:
            extrinsics = self.extrinsics(rays.uv, rays.object_id, rays.p_camera)
            if self.config.extrinsics == "view":
                features = torch.cat([features, extrinsics], dim=-1)
            else:
                before, turned = features[..., : SH_CHANNELS.start], features[..., SH_CHANNELS] * extrinsics
                features = torch.cat([before, turned, features[..., SH_CHANNELS.stop :]], dim=-1)
        # Channels stay last in memory, which is the order that convolutions on a CPU want.
        pictures = self.net(features.flatten(1).view(*rays.grid, -1).permute(0, 3, 1, 2))
        colors = pictures.permute(0, 2, 3, 1).reshape(-1, 3)
        return (colors + 1) / 2, (diffuse + 1) / 2

    def regularisation(self) -> Float32[Tensor, ""]:
        """The mean squares of each level's texels, weighted by level."""
        means = [table.square().mean() for table in self.textures.tables()]
        return torch.stack([weight * mean for weight, mean in zip(LEVEL_WEIGHTS, means)]).sum()


def image_loss(
    renderer: nn.Module,
    training: PixelSource,
    batch: int,
    rng: np.random.Generator,
    *,
    patch_terms: PatchTerms | None = None,
) -> Tensor:
    """What deferred neural rendering makes small on random crops of about `batch` pixels in all.

    The mean absolute differences of the output and of the first three texture channels (where the first layer is not
    empty) from the picture, in the network's own range of -1 to 1; and the regularised textures.
    Patch terms look at the same crops. Source: Thies et al. 2019, and the first author's public code for the levels'
    weights.
    """
    assert isinstance(renderer, DnrRenderer)
    config = renderer.config
    crop = config.crop or side_of(training)
    index = draw_patches(training, max(1, round(batch / crop**2)), crop, rng, strides=config.strides)
    rays = training.take(index, rng)
    colors, diffuse = renderer.shade(rays)
    truth = take_colors(training, index.flatten())
    loss = 2 * (colors - truth).abs().mean()
    if config.texture_color:
        is_hit = rays.object_id[:, :1] != 0
        difference = ((diffuse - truth).abs() * is_hit).sum() / (3 * is_hit.sum()).clamp_min(1)
        loss = loss + config.texture_color * 2 * difference
    if patch_terms is not None:
        shape = (*index.shape, 3)
        loss = loss + 2 * patch_terms.of(colors.view(shape), truth.view(shape))
    if config.regularisation:
        loss = loss + config.regularisation * renderer.regularisation()
    return loss


def build_dnr(config: DnrConfig, dataset: Dataset, geometry: str, num_layers: int) -> DnrRenderer:
    """A fresh renderer for a dataset; its random start is drawn from torch's default generator."""
    positions = positions_for(config.extrinsics, dataset, geometry, config.position_size)
    return DnrRenderer(config, num_layers=num_layers, num_objects=len(dataset.objects), positions=positions)
