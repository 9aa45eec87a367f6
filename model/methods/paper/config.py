"""Configuration of the paper's methods: `paper`, `paper-best`, `mlp-first`, and Deferred Neural Rendering (`dnr`)."""

import dataclasses
from dataclasses import dataclass
from typing import ClassVar, Self

from datagen.disk.errors import HyalineError
from model.methods.protocol import MethodConfig
from model.settings import (
    AMOUNT,
    Extrinsics,
    LossConfig,
    Norm,
    PixelOptimisation,
    UNetNorm,
    check_samples,
    check_texels,
    check_width,
    choice,
    unflagged,
)

LEVEL_WEIGHTS = (8.0, 2.0, 1.0, 0.0)
"""How strongly each texture level is regularised towards zero, finest first, so that detail appears only if needed."""

LEAST_CROP = 128
"""Least height and width in pixels of the default training crops."""

SH_CHANNELS = slice(3, 12)
"""The texture channels that the nine spherical harmonics of the view vector multiply."""


@dataclass(frozen=True, kw_only=True)
class PaperConfig(MethodConfig):
    """The paper's renderer: neural textures on straight layers, stacked and shaded by a network for each pixel."""

    room: ClassVar[str] = "model.methods.paper.renderer"
    page: ClassVar[str] = "model.methods.paper.renderer"
    reads_layers: ClassVar[bool] = True
    draws_cameras: ClassVar[bool] = True

    extrinsics: Extrinsics = choice("view", {"none": "no-extrinsics", "sh": "sh"})
    """Camera input of each layer (section 4.6): none, the view vector (view), or its spherical harmonics in three bands
    (sh)."""
    width: int = choice(0, "w{}", flag="hidden", limits=(0, 8192))
    """Hidden units of the first layer; 0: chosen so that three blocks have 34,000 parameters (section 4.3). The paper's
    text has 256, which contradicts its 34k."""
    blocks: int = choice(3, "{}-blocks", limits=(0, 8))
    """Residual blocks; each halves the channels at its end (section 4.3). Their number does not change the width."""
    norm: Norm = choice("batch", {"none": "no-norm", "batch": "batch-norm"})
    """Batch norm after each linear layer but the last (section 4.3), or none (the authors' code)."""
    texture_size: int = choice(0, "t{}")
    """Width and height of an object's texture in texels; 0: half the image's width, or all of it with paper-best."""
    zero_layer: bool = choice(False, "zero-layer")
    """Insert a layer of zeros at a random position in training, and after all others at test (section 4.4)."""
    layers: str = choice("all", "{}-layers", flag="use-layers")
    """Straight layers to look up: all (as stored), a number (the nearest ones), online (traced for each batch, through
    a random point of each pixel; no stored layer is read) or both, such as online-4."""
    train_samples: int = choice(1, "{}-rays", flag="rays")
    """Rays per pixel while training, a square number; the paper uses one, through the pixel's centre. With more, in
    training or rendering, layers are traced for each batch instead of being read, and colours are averaged."""
    render_samples: int = choice(1, "{}-render-rays", flag="render-rays")
    """Rays per pixel while rendering, a square number."""
    texture_features: int = choice(16, "{}-features", flag="features", limits=(1, 256))
    """Channels of a texture (section 4.3); 64 in the paper's runs on coarse proxies."""
    texture_levels: int = choice(1, "{}-levels", limits=(1, 8))
    """Textures summed, each half as wide as the one before; the paper has one (section 4.3), DNR has 4."""
    finer_counts: float = unflagged(1.0, limits=(0.001, 1))
    """Weight of a texture level relative to the next coarser one."""
    texels_per_pixel: float = unflagged(0.5, limits=(1 / 64, 64))
    """Width of an object's texture as a fraction of the image's width, where `texture_size` is 0."""
    position_size: int = unflagged(512)
    """Width and height of the position textures of Eq. 3 in texels; the size that the authors ran."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width:
            check_width(self.width, self.blocks)
        check_texels("texture_size", self.texture_size, is_open=True)
        check_texels("position_size", self.position_size)
        for name in ("train_samples", "render_samples"):
            check_samples(name, getattr(self, name))
        word, dash, number = self.layers.rpartition("-")
        if self.layers not in ("all", "online") and (not number.isdecimal() or (dash and word != "online")):
            raise HyalineError(f"layers: is {self.layers!r}; expected all, a number, online, or both such as online-4")

    def optimisation(self) -> PixelOptimisation:
        return PixelOptimisation(loss=LossConfig(vgg_weights="auto"))

    @property
    def asked_layers(self) -> int | None:
        number = self.layers.rpartition("-")[2]
        return int(number) if number.isdecimal() else None

    @property
    def traces_layers(self) -> bool:
        return self.layers.startswith("online") or max(self.train_samples, self.render_samples) > 1

    def hurried(self) -> Self:
        return dataclasses.replace(self, render_samples=1)


@dataclass(frozen=True, kw_only=True)
class PaperBestConfig(PaperConfig):
    """The paper's method, tuned: more texture levels, rays and steps; no batch norm."""

    def usual(self, geometry: str) -> Self:  # noqa: ARG002
        return type(self)(
            width=128,
            norm="none",
            texture_levels=5,
            finer_counts=0.5,
            texels_per_pixel=1.0,
            train_samples=4,
            render_samples=16,
        )

    def optimisation(self) -> PixelOptimisation:
        # Half as many rays a step as the published form, and seven tenths of its rays in all.
        return PixelOptimisation(
            steps=3500,
            batch=1024,
            optimizer="muon",
            lr=0.003,
            texture_lr=0.02,
            lr_decay="cosine",
            loss=LossConfig(softness=0.03),
        )


@dataclass(frozen=True, kw_only=True)
class MlpFirstConfig(PaperConfig):
    """The paper's network on the first layer alone."""

    max_layers: ClassVar[int | None] = 1


@dataclass(frozen=True, kw_only=True)
class DnrConfig(MethodConfig):
    """Deferred Neural Rendering: a U-Net on the neural textures of the first layer.

    Defaults: Thies et al. 2019 (arXiv 1904.12356), after the first author's public code, with the 16 features of the
    reproduced paper.
    """

    room: ClassVar[str] = "model.methods.paper.dnr"
    reads_layers: ClassVar[bool] = True
    whole_views: ClassVar[bool] = True
    max_layers: ClassVar[int | None] = 1
    draws_cameras: ClassVar[bool] = True

    unet_width: int = choice(64, "u{}", limits=(1, 1024))
    """Channels of the U-Net's first level; 16 makes it 16 times smaller, for CPUs."""
    texture_features: int = choice(16, "{}-features", flag="features")
    """Channels of a texture."""
    extrinsics: Extrinsics = choice("sh", {"none": "no-extrinsics", "view": "view", "sh": "sh"})
    """Camera input of each layer: none, the view vector (view), or its spherical harmonics in three bands, which
    multiply nine features of each pixel (sh)."""
    texture_size: int = choice(0, "t{}")
    """Width and height of an object's finest texture in texels; 0: half the image's width."""
    texture_levels: int = choice(4, "{}-levels", limits=(1, len(LEVEL_WEIGHTS)))
    """Number of textures summed, each half as wide as the one before."""
    crop: int | None = choice(None, "crop{}", limits=AMOUNT)
    """Height and width of training crops in pixels; 0: whole images; None: half the image's width, but at least 128."""
    position_size: int = unflagged(512)
    """Width and height in texels of the position textures that view vectors are computed from."""
    norm: UNetNorm = unflagged("instance")
    strides: tuple[int, ...] = unflagged((1, 2))
    """Random scales of the crops: every pixel or every second one. Pictures are only subsampled, because uv must not
    be interpolated across seams."""
    texture_color: float = unflagged(1.0, limits=AMOUNT)
    """Weight of the difference between the first three texture channels and the picture, relative to the output's."""
    regularisation: float = unflagged(0.1, limits=AMOUNT)
    """Weight of the mean squares of the texels, itself weighted by level."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_texels("texture_size", self.texture_size, is_open=True)
        least = SH_CHANNELS.stop if self.extrinsics == "sh" else 3
        if not least <= self.texture_features <= 256:
            raise HyalineError(
                f"features: is {self.texture_features} with extrinsics {self.extrinsics}; expected {least} to 256"
            )
        if min(self.strides, default=0) < 1:
            raise HyalineError(f"strides: are {self.strides}; expected at least 1 pixel")

    def optimisation(self) -> PixelOptimisation:
        # About as many pixels per step as a picture of the demo has.
        return PixelOptimisation(batch=16_384)


@dataclass(frozen=True, kw_only=True)
class DnrLayersConfig(DnrConfig):
    """Deferred Neural Rendering on all straight layers."""

    max_layers: ClassVar[int | None] = None


@dataclass(frozen=True, kw_only=True)
class DnrAuthorsConfig(DnrConfig):
    """Deferred Neural Rendering in the weaker variant that the reproduced paper used.

    8 features, one level, the view vector as an input, whole images.
    """

    def usual(self, geometry: str) -> Self:  # noqa: ARG002
        return type(self)(
            texture_levels=1,
            texture_features=8,
            extrinsics="view",
            norm="batch",
            crop=0,
            strides=(1,),
            texture_color=0.0,
            regularisation=0.0,
        )
