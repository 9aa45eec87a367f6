"""The renderer of `dnr` and `dnr-layers`: Deferred Neural Rendering, on the first layer alone and on all of them."""

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from model.batches.rays import PixelSource, RayBatch, draw_patches, take_colors
from model.losses.pixel_losses import PatchTerms
from model.methods.dnr.config import LEVEL_WEIGHTS, SH_CHANNELS, DnrConfig
from model.methods.protocol import Inputs
from model.methods.renderer import Renderer
from model.nets.extrinsics import ExtrinsicInputs, positions_for
from model.nets.texture import TexturePyramid, object_layout
from model.nets.unet import UNet


class DnrRenderer(Renderer[PixelSource[RayBatch]]):
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

    def loss(
        self,
        training: PixelSource[RayBatch],
        batch: int,
        rng: np.random.Generator,
        *,
        softness: float = 0.0,  # noqa: ARG002
        patch_terms: PatchTerms | None = None,
    ) -> Tensor:
        """What deferred neural rendering makes small on random crops of about `batch` pixels in all.

        The mean absolute differences of the output and of the first three texture channels (where the first layer is
        not empty) from the picture, in the network's own range of -1 to 1; and the regularised textures.
        Patch terms look at the same crops. Source: Thies et al. 2019, and the first author's public code for the
        levels' weights.
        """
        config = self.config
        crop = config.crop or training.resolution.shorter
        index = draw_patches(training, max(1, round(batch / crop**2)), crop, rng, strides=config.strides)
        rays = training.take(index, rng)
        colors, diffuse = self.shade(rays)
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
            loss = loss + config.regularisation * self.regularisation()
        return loss

    def regularisation(self) -> Float32[Tensor, ""]:
        """The mean squares of each level's texels, weighted by level."""
        means = [table.square().mean() for table in self.textures.tables()]
        return torch.stack([weight * mean for weight, mean in zip(LEVEL_WEIGHTS, means)]).sum()


def build_dnr(config: DnrConfig, inputs: Inputs) -> DnrRenderer:
    """A fresh renderer for a dataset; its random start is drawn from torch's default generator."""
    positions = positions_for(config.extrinsics, inputs.dataset, inputs.geometry, config.position_size)
    return DnrRenderer(
        config, num_layers=inputs.num_layers, num_objects=len(inputs.dataset.objects), positions=positions
    )
