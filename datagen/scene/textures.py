"""What colours a surface: one colour, a procedural texture, or an image."""

from dataclasses import dataclass
from typing import Literal

from datagen.disk.errors import HyalineError
from datagen.disk.names import check_relative
from datagen.scene.values import Color, Vector, check_positive, check_range


@dataclass(frozen=True, kw_only=True)
class SolidTexture:
    """A procedural texture carved from space, so that it knows no seams; baked into the object's atlas."""

    pattern: Literal["checker", "stripes", "wood", "marble", "speckle"]
    colors: tuple[Color, Color]
    """Linear reflectance, each in [0, 1]."""
    scale: float
    """Length of one period in metres."""
    axis: Literal["x", "y", "z"] = "x"
    """Stripes and wood run across this axis; the other patterns have none."""
    origin: Vector = (0.0, 0.0, 0.0)
    """Where the pattern begins, in metres: an object that is moved takes its pattern along."""

    def __post_init__(self) -> None:
        for color in self.colors:
            check_range("texture color", color, 0, 1)
        check_positive("texture scale", self.scale)


@dataclass(frozen=True, kw_only=True)
class ImageTexture:
    """An sRGB PNG in the object's own uv, for scenes that bring their own."""

    path: str
    """Relative to the scene's folder."""

    def __post_init__(self) -> None:
        check_relative(self.path, where="texture path")
        if not self.path.endswith((".png", ".PNG")):
            raise HyalineError(f"texture path: is {self.path!r}; expected a PNG inside the scene's folder")


Reflectance = Color | SolidTexture | ImageTexture


def check_reflectance(color: Reflectance) -> None:
    """Refuses a colour that would make light; textures check themselves."""
    if isinstance(color, tuple):
        check_range("color", color, 0, 1)
