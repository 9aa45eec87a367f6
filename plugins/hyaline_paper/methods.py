"""Configurations of the methods `authors-code` and `deepvoxels`."""

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar, Self

from datagen.data.config import Resolution
from datagen.disk.errors import HyalineError
from model.methods.protocol import MethodConfig
from model.settings import Extrinsics, Optimisation, PixelOptimisation, check_texels, choice, unflagged

LEAST_WIDTH = 4
"""Halving the channels stops here."""


@dataclass(frozen=True, kw_only=True)
class AuthorsConfig(MethodConfig):
    """The renderer of the paper's released code; defaults as in the scripts for its Table 1."""

    room: ClassVar[str] = "hyaline_paper.authors_code"
    reads_layers: ClassVar[bool] = True
    draws_cameras: ClassVar[bool] = True

    extrinsics: Extrinsics = choice("view", {"none": "no-extrinsics", "sh": "sh"})
    """Camera input of each layer: none, the vector from the camera to the surface (view), or nine more channels;
    channels 3 to 11 are then multiplied by the vector's spherical harmonics without their constants (sh)."""
    width: int = choice(64, "w{}", flag="hidden", limits=(LEAST_WIDTH, 8192))
    """Hidden units of the first layer: 64, because the code ignores the 256 that its scripts ask for."""
    texture_features: int = choice(16, "{}-features", flag="features", limits=(3, 256))
    """Channels of a texture; nine more with sh."""
    texture_size: int = choice(0, "t{}")
    """Width and height of a texture in texels; 0: half the image's width, 256 for their 512 pixels."""
    texture_start: float = unflagged(0.5)
    position_size: int = unflagged(512)
    blocks: int = unflagged(3, limits=(0, 8))
    dropout: float = unflagged(0.2)
    """Share of activations; it stays on while rendering, as in their test script."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_texels("texture_size", self.texture_size, is_open=True)
        check_texels("position_size", self.position_size)

    def optimisation(self) -> PixelOptimisation:
        return PixelOptimisation(beta1=0.5, weight_decay=1e-4)


@dataclass(frozen=True, kw_only=True)
class DeepVoxelsConfig(MethodConfig):
    """DeepVoxels, small: a grid of learned features, from cameras alone.

    For machines without a GPU: 1/14 of the authors' parameters, no dropout, a bounded grid, L1 at rate 0.002.
    """

    room: ClassVar[str] = "hyaline_paper.deepvoxels"
    knowledge: ClassVar[str] = "cameras only, and the scene's extent"
    uses_geometry: ClassVar[bool] = False
    draws_cameras: ClassVar[bool] = True

    image_size: int = unflagged(0)
    """Width and height of the images, a power of two; 0: not known yet. The authors use 512; so from 128 on."""
    num_voxels: int = unflagged(32)
    """Along each edge of the grid."""
    plane_size: int = unflagged(32)
    """Width and height on which features are lifted and projected: a power of two below the pictures' size. Each
    halving from the pictures to it is a stage of the feature extractor, and one of the rendering network."""
    voxel_features: int = unflagged(32, limits=(1, 4096))
    width: int = unflagged(16, limits=(2, 4096))
    """Channels of the outermost 2-D convolutions; the deepest have eight times as many."""

    def optimisation(self) -> Optimisation:
        return Optimisation(batch=2, lr=2e-3)  # A batch is the pictures drawn in a step.

    def sized(self, resolution: Resolution) -> Self:
        """The same for pictures of this size."""
        side = resolution.mean_side
        if resolution.width != resolution.height or side.bit_count() != 1 or side < 16:
            raise HyalineError(
                f"resolution: is {resolution}; deepvoxels needs square pictures whose width is a power of two, "
                f"so build the dataset with --resolution {max(16, 2 ** round(math.log2(side)))}"
            )
        return dataclasses.replace(self, image_size=side, plane_size=min(self.plane_size, side // 2))
