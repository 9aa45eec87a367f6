"""Configuration of the method `authors-code`."""

from dataclasses import dataclass
from typing import ClassVar

from datagen.disk.errors import HyalineError
from model.methods.protocol import MethodConfig
from model.settings import Extrinsics, PixelOptimisation, check_texels, choice, unflagged

LEAST_WIDTH = 4
"""Halving the channels stops here."""


@dataclass(frozen=True, kw_only=True)
class AuthorsConfig(MethodConfig):
    """The renderer of the paper's released code; defaults as in the scripts for its Table 1."""

    room: ClassVar[str] = "hyaline_paper.authors_code.renderer"
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
    zero_layer: bool = choice(False, "zero-layer")
    """Insert a layer of zeros at a random position in training, and after all others at test (their `--pad_front`)."""
    test_dropout: bool = choice(True, "no-test-dropout")
    """Keep dropout on while rendering, as their test script does. It is seeded by the batch's uv, so
    predictions are repeatable."""
    texture_start: float = unflagged(0.5)
    position_size: int = unflagged(512)
    blocks: int = unflagged(3, limits=(0, 8))
    dropout: float = unflagged(0.2)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_texels("texture_size", self.texture_size, is_open=True)
        check_texels("position_size", self.position_size)
        if not 0 <= self.dropout < 1:
            raise HyalineError(f"dropout: is {self.dropout}; expected a share in [0, 1), 0.2 in the code")

    def optimisation(self) -> PixelOptimisation:
        return PixelOptimisation(beta1=0.5, weight_decay=1e-4)
