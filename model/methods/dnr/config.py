"""Configuration of the methods `dnr`, `dnr-layers` and `dnr-authors`."""

from dataclasses import dataclass
from typing import ClassVar, Self

from datagen.disk.errors import HyalineError
from model.methods.protocol import MethodConfig
from model.settings.flags import AMOUNT, choice, unflagged
from model.settings.network_parts import Extrinsics, UNetNorm, check_texels
from model.settings.optimisation import PixelOptimisation

LEVEL_WEIGHTS = (8.0, 2.0, 1.0, 0.0)
"""How strongly each texture level is regularised towards zero, finest first, so that detail appears only if needed."""

LEAST_CROP = 128
"""Least height and width in pixels of the default training crops."""

SH_CHANNELS = slice(3, 12)
"""The texture channels that the nine spherical harmonics of the view vector multiply."""


@dataclass(frozen=True, kw_only=True)
class DnrConfig(MethodConfig):
    """Deferred Neural Rendering: a U-Net on the neural textures of the first layer.

    Defaults: Thies et al. 2019 (arXiv 1904.12356), after the first author's public code, with the 16 features of the
    reproduced paper.
    """

    room: ClassVar[str] = "model.methods.dnr.renderer"
    reads_layers: ClassVar[bool] = True
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
