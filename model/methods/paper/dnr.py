"""The renderer of `dnr` and `dnr-layers`: Deferred Neural Rendering, on the first layer alone and on all of them."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

from datagen.disk.errors import HyalineError
from model.batches.rays import PixelSource, RayBatch, draw_patches, take_colors
from model.methods.paper.config import LEAST_CROP, LEVEL_WEIGHTS, SH_CHANNELS, DnrConfig
from model.methods.paper.renderer import default_texture_size
from model.methods.protocol import Inputs
from model.methods.renderer import PatchTerms, Renderer
from model.nets.pixel_mlp import ExtrinsicInputs, positions_for
from model.nets.texture import TexturePyramid, object_layout
from model.settings import UNetNorm


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
        """sRGB colours of the pixels, and the colours that the first layer's first three features give alone."""
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
        """The loss of deferred neural rendering on random crops of about `batch` pixels in all.

        The mean absolute differences of the output and of the first three texture channels (where the first layer is
        not empty) from the picture, in the network's own range of -1 to 1, plus the texture regularisation. Patch terms
        use the same crops. Source: Thies et al. 2019; level weights from the first author's public code.
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


NUM_HALVINGS = 5
"""The network works on pictures whose height and width are multiples of 2 ** NUM_HALVINGS."""

LEAKY_SLOPE = 0.2


class UNet(nn.Module):
    """The five-level U-Net of pix2pix with 4 x 4 kernels and strides of 2; 16,671,107 parameters for 16 inputs.

    Source: Thies et al. 2019 (arXiv 1904.12356), layers as in the first author's public code: only the decoder is
    normalised, except the inputs of its first and last layers. `batch` is what the transparent paper's authors ran:
    batch statistics of one picture, at test, too.
    """

    def __init__(self, num_inputs: int, *, width: int = 64, norm: UNetNorm = "instance") -> None:
        super().__init__()
        down = [width, 2 * width, 4 * width, 8 * width, 8 * width]
        self.down = nn.ModuleList(
            nn.Conv2d(before, after, 4, stride=2, padding=1) for before, after in zip([num_inputs, *down], down)
        )
        # From the second on, each takes the previous output concatenated with the encoder's at the same resolution.
        up = [(8 * width, 8 * width), (16 * width, 4 * width), (8 * width, 2 * width), (4 * width, width)]
        self.up = nn.ModuleList(nn.ConvTranspose2d(*pair, 4, stride=2, padding=1) for pair in up)
        self.norms = nn.ModuleList(
            nn.InstanceNorm2d(after) if norm == "instance" else nn.BatchNorm2d(after, track_running_stats=False)
            for _, after in up
        )
        self.last = nn.ConvTranspose2d(2 * width, 3, 4, stride=2, padding=1)

    def forward(self, x: Float32[Tensor, "b c h w"]) -> Float32[Tensor, "b 3 h w"]:
        """Colours in (-1, 1) of pictures of any size, which are zero-padded below and to the right internally."""
        height, width = x.shape[-2:]
        step = 1 << NUM_HALVINGS
        x = functional.pad(x, (0, -width % step, 0, -height % step))
        skips = []
        for place, conv in enumerate(self.down):
            x = conv(x if place == 0 else functional.leaky_relu(x, LEAKY_SLOPE))
            skips.append(x)
        x = skips.pop()
        for conv, norm in zip(self.up, self.norms, strict=True):
            x = torch.cat([skips.pop(), norm(conv(functional.relu(x)))], dim=1)
        return torch.tanh(self.last(functional.relu(x)))[..., :height, :width]


def complete(config: DnrConfig, inputs: Inputs) -> DnrConfig:
    """The same with sizes that follow from the picture's.

    Textures are as wide as those of `paper`, half the picture's side for each object, so that the methods differ only
    in their networks. Crops are squares of half the picture's shorter side (256 of 512 pixels is common), but at least
    128 pixels: in a narrower one the U-Net's innermost level sees only the border, unlike in a whole picture (measured
    on the glass table at 128 pixels: crops of 64 cost 3 dB on both splits).
    """
    resolution = inputs.dataset.config.resolution
    side = resolution.shorter
    crop = min(side, max(side // 2, LEAST_CROP)) if config.crop is None else config.crop
    if crop > side:
        raise HyalineError(f"crop: is {crop}; expected at most {side}, the shorter side of pictures of {resolution}")
    size = config.texture_size or default_texture_size(resolution.mean_side)
    return dataclasses.replace(config, texture_size=size, crop=crop)


def build(config: DnrConfig, inputs: Inputs) -> DnrRenderer:
    positions = positions_for(config.extrinsics, inputs.dataset, inputs.geometry, config.position_size)
    return DnrRenderer(
        config, num_layers=inputs.num_layers, num_objects=len(inputs.dataset.objects), positions=positions
    )
