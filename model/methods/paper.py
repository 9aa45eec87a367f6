"""Owns the method `paper`: neural textures on straight layers, stacked into a per-pixel residual MLP."""

import math
import shlex
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx

from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from model.batches.rays import Pixels, RayBatch, insert_random_layer
from model.batches.samples import check_samples, linear_curve, srgb_curve
from model.nets.cpu.mlp_kernels import Stacks
from model.nets.extrinsics import EXTRINSIC_CHANNELS, ExtrinsicInputs, Extrinsics, positions_for
from model.nets.pixel_mlp import FoldedMlp, Norm, PixelMlp, Precision, check_width, width_for_34k
from model.nets.texture import NeuralTextures, TexturePyramid, TextureSharing, make_layout, places_of
from model.settings.choices import PaperChoices
from model.settings.paper_presets import PAPER_PRESETS

START_ALONE = 0.5
"""Where textures start when they are all that the network sees (the authors' code starts so, always). From zeros its
first batch norm would divide by the spread of next to nothing, blow the first steps' signs up, and leave walls in
blotches: measured on the glass table at 128 pixels after 1,200 steps, 23.4 dB on held-out views; 26.3 from noise of
0.1, 27.4 from one half."""


@dataclass(frozen=True, kw_only=True)
class PaperConfig:
    """What the paper's renderer is made of."""

    width: int
    """Hidden units of the first linear layer; the command's `34k` finds it from the number of inputs (section 4.3)."""
    texture_size: int
    """Width and height of a texture in texels; the command's default is `default_texture_size`."""
    blocks: int = 3
    """Residual blocks, each of which ends by halving the channels (section 4.3)."""
    norm: Norm = "batch"
    """Batch norm after each linear layer but the last (section 4.3)."""
    extrinsics: Extrinsics = "view"
    """What each layer is told of the camera (section 4.6)."""
    textures: TextureSharing = "object"
    """One texture an object (section 4.4), or one for the scene, in which each object has a cell."""
    num_layers: int | None = None
    """Layers that are looked up, the nearest ones; None: all that are stored."""
    online: bool = False
    """Layers are traced for each batch, while training through a random place of each pixel, and none is read."""
    texture_features: int = 16
    """Channels of a texture (section 4.3); 64 on coarse proxies."""
    texture_levels: int = 1
    """Textures summed, each half as wide as the one before; the paper has one (section 4.3)."""
    finer_counts: float = 1.0
    """How much a texture level counts beside the next coarser one."""
    position_size: int = 512
    """Width and height of the position textures of Eq. 3 in texels; the size that the authors ran."""
    zero_layer: bool = False
    """Insert a layer of zeros at a random place while training, and behind all others at test (section 4.4)."""
    train_samples: int = 1
    """Rays per pixel while training, a square number; the paper has one, through the pixel's centre. With more, in
    training or in rendering, layers are traced for each batch instead of read, and colours are averaged."""
    render_samples: int = 1
    """Rays per pixel while rendering, a square number."""
    precision: Precision = "fp32"
    """Numbers that the network multiplies, in training and in rendering."""

    def __post_init__(self) -> None:
        check_width(self.width, self.blocks)
        for name in ("texture_size", "position_size"):
            if not 2 <= getattr(self, name) <= 8192:
                raise HyalineError(f"{name}: is {getattr(self, name)}; expected 2 to 8192 texels")
        for name in ("train_samples", "render_samples"):
            check_samples(name, getattr(self, name))
        if not 1 <= self.texture_features <= 256:
            raise HyalineError(f"texture_features: is {self.texture_features}; expected 1 to 256")
        if not 1 <= self.texture_levels <= 8:
            raise HyalineError(f"texture_levels: is {self.texture_levels}; expected 1 to 8")
        if not 0 < self.finer_counts <= 1:
            raise HyalineError(f"finer_counts: is {self.finer_counts}; expected more than 0, at most 1")


def default_texture_size(
    resolution: int, num_objects: int, sharing: TextureSharing, *, texels_per_pixel: float = 0.5
) -> int:
    """Half the image's width for each object, as the authors ran it: 256 texels for frames of 512 pixels.

    With more, the texels of small objects are seen so rarely that they learn single pixels by heart: at 128 pixels, 256
    texels cost 1.9 dB (interpolating) and 1.1 dB (extrapolating) against 64. (A pyramid of textures does not.)
    """
    cells = 1 if sharing == "object" else math.ceil(math.sqrt(num_objects))
    return cells * max(16, int(resolution * texels_per_pixel))


def configure_paper(choices: PaperChoices, dataset: Dataset, geometry: str, num_layers: int) -> PaperConfig:
    """The configuration that a user's choices make on a dataset with so many layers.

    Raises:
        HyalineError: a choice that cannot be.
    """
    preset = PAPER_PRESETS[choices.preset]
    asked_layers, online = parse_layers(choices.layers)
    inputs = count_inputs(
        choose_layers(asked_layers, num_layers, more=_deeper_command(dataset, geometry, asked_layers)),
        texture_features=choices.features,
        extrinsics=choices.extrinsics,
        zero_layer=choices.zero_layer,
    )
    width = choices.width or preset.width
    if width != "34k" and not width.isdecimal():
        raise HyalineError(f"width: is {width!r}; expected 34k, 256 or another number of hidden units")
    size = choices.texture_size or default_texture_size(
        dataset.config.resolution, len(dataset.objects), choices.textures, texels_per_pixel=preset.texels_per_pixel
    )
    return PaperConfig(
        width=width_for_34k(inputs, choices.blocks) if width == "34k" else int(width),
        blocks=choices.blocks,
        norm=choices.norm or preset.norm,
        extrinsics=choices.extrinsics,
        textures=choices.textures,
        texture_size=size,
        texture_features=choices.features,
        texture_levels=choices.texture_levels or preset.texture_levels,
        finer_counts=preset.finer_counts,
        zero_layer=choices.zero_layer,
        num_layers=asked_layers,
        online=online,
        train_samples=preset.rays if choices.rays is None else choices.rays,
        render_samples=preset.render_rays if choices.render_rays is None else choices.render_rays,
        precision=choices.precision,
    )


def parse_layers(text: str | None) -> tuple[int | None, bool]:
    """How many layers a user asks for, None for all, and whether they are traced for each batch.

    Raises:
        HyalineError: neither a number, nor online, nor both.
    """
    if text is None:
        return None, False
    word, dash, number = text.rpartition("-")
    if text == "online":
        return None, True
    if not number.isdecimal() or (dash and word != "online"):
        raise HyalineError(f"layers: is {text!r}; expected a number, online, or both such as online-4")
    return int(number), bool(dash)


def _deeper_command(dataset: Dataset, geometry: str, num_layers: int | None) -> str:
    words = ["datagen", "peel", "--dataset", str(dataset.root), "--geometry", geometry]
    return f" (`{shlex.join([*words, '--num-layers', str(num_layers), '--overwrite'])}` stores more)"


def choose_layers(asked: int | None, num_stored: int, *, more: str = "") -> int:
    """How many layers a renderer looks up: all that are stored, or the nearest ones of them.

    Args:
        more: in words, what stores more.

    Raises:
        HyalineError: none, or more than are stored.
    """
    if asked is None:
        return num_stored
    if not 1 <= asked <= num_stored:
        raise HyalineError(
            f"layers: is {asked}; expected 1 to {num_stored}, as many as are stored{more if asked > 0 else ''}"
        )
    return asked


def count_inputs(num_layers: int, *, texture_features: int, extrinsics: Extrinsics, zero_layer: bool) -> int:
    """Inputs of the network: features and extrinsics of all layers, the zero layer included."""
    return (num_layers + zero_layer) * (texture_features + EXTRINSIC_CHANNELS[extrinsics])


class PaperRenderer(nn.Module):
    """Rays with layers in, sRGB colours of their pixels out."""

    def __init__(
        self, config: PaperConfig, *, num_layers: int, num_objects: int, positions: Float32[Tensor, "texel 3"] | None
    ) -> None:
        super().__init__()
        self.zero_layer = config.zero_layer
        sizes = [config.texture_size >> level for level in range(config.texture_levels)]
        layouts = [make_layout(num_objects, size, config.textures) for size in sizes]
        start = START_ALONE if config.extrinsics == "none" else 0.0
        self.textures = (
            NeuralTextures(layouts[0], config.texture_features, start=start)
            if len(layouts) == 1
            else TexturePyramid(layouts, config.texture_features, finer_counts=config.finer_counts, start=start)
        )
        self.extrinsics = (
            None
            if positions is None
            else ExtrinsicInputs(config.extrinsics, positions, num_objects=num_objects, size=config.position_size)
        )
        num_inputs = count_inputs(
            num_layers,
            texture_features=config.texture_features,
            extrinsics=config.extrinsics,
            zero_layer=config.zero_layer,
        )
        self.net = PixelMlp(
            num_inputs, width=config.width, blocks=config.blocks, norm=config.norm, precision=config.precision
        )

    def forward(
        self, rays: RayBatch, *, rng: np.random.Generator | None = None, folded: FoldedMlp | None = None
    ) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours of the pixels, about [0, 1]; several rays of a pixel are averaged in linear light.

        Args:
            rng: draws the place of each ray's zero layer while training; without it that layer comes last.
            folded: the network's fast form, for rendering.
        """
        if self.zero_layer:
            rays = insert_random_layer(rays, rng)
        stack = self.textures(rays.uv, rays.object_id)
        if self.extrinsics is not None:
            stack = _Beside.apply(stack, self.extrinsics(rays.uv, rays.object_id, rays.p_camera))
        colors = (self.net if folded is None else folded)(stack.flatten(1))
        if rays.samples == 1:
            return colors
        return srgb_curve(linear_curve(colors).view(-1, rays.samples, 3).mean(dim=1))

    def draw(self, pixels: Pixels, folded: FoldedMlp) -> Float32[Tensor, "pixel 3"] | None:
        """The colours of all pixels, looked up and drawn by one compiled loop; None where there is none for this."""
        has_loop = self.extrinsics is None or self.extrinsics.kind == "view"
        if folded.kernels is None or folded.network is None or not has_loop:
            return None
        if not isinstance(self.textures, NeuralTextures) or pixels.device.type != "cpu":
            return None
        stacks = Stacks(
            uv=pixels.uv,
            object_id=pixels.object_id,
            texels=self.textures.table.detach(),
            places=places_of(self.textures.layout),
            positions=None if self.extrinsics is None else self.extrinsics.positions,
            position_places=None if self.extrinsics is None else places_of(self.extrinsics.layout),
            p_camera=pixels.p_camera,
            pixels_per_view=pixels.pixels_per_view,
        )
        return folded.kernels.draw_stacks(folded.network, stacks)


class _Beside(torch.autograd.Function):
    """`torch.cat` over the last axis, without a gradient of the second part.

    That one copies such short rows one by one, which takes 5 ms a step of 8,192 pixels; this takes 1.
    """

    @staticmethod
    def forward(ctx: FunctionCtx, features: Tensor, inputs: Tensor) -> Tensor:
        num_features = features.shape[-1]
        stack = features.new_empty(*features.shape[:-1], num_features + inputs.shape[-1])
        stack[..., :num_features], stack[..., num_features:] = features, inputs
        ctx.num_features = num_features  # pyright: ignore[reportAttributeAccessIssue]
        return stack

    @staticmethod
    def backward(ctx: FunctionCtx, *upstream: Tensor) -> tuple[Tensor, None]:
        return upstream[0][..., : ctx.num_features], None  # pyright: ignore[reportAttributeAccessIssue]


def build_paper(config: PaperConfig, dataset: Dataset, geometry: str, num_layers: int) -> PaperRenderer:
    """A fresh renderer for a dataset of so many stored layers; its start is drawn from torch's default generator."""
    positions = positions_for(config.extrinsics, dataset, geometry, config.position_size)
    num_layers = choose_layers(config.num_layers, num_layers)
    return PaperRenderer(config, num_layers=num_layers, num_objects=len(dataset.objects), positions=positions)
