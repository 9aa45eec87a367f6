"""What lights a scene: a soft sky or a map of it, and lamps."""

import math
from dataclasses import dataclass

from datagen.disk.errors import HyalineError
from datagen.disk.names import check_relative
from datagen.scene.values import Color, Vector, check_positive, check_range

MAP_ENDINGS = (".exr", ".hdr")
"""Of files of linear radiance: OpenEXR, and Radiance's RGBE."""


@dataclass(frozen=True, kw_only=True)
class Lobe:
    """A soft round light in the sky: radiance falls off as exp(sharpness (cos angle - 1)).

    Sharpness 20 is about 36 degrees wide at half height; small lights make fireflies behind glass.
    """

    direction: Vector
    """Towards the light; any length."""
    radiance: Color
    sharpness: float

    def __post_init__(self) -> None:
        check_positive("lobe direction", math.hypot(*self.direction))
        check_range("lobe radiance", self.radiance, 0, math.inf)
        check_positive("lobe sharpness", self.sharpness)


@dataclass(frozen=True, kw_only=True)
class Card:
    """A rectangle in the sky that covers what is behind it: bright, a photographer's softbox, or black, a flag.

    Glass shows itself by what it mirrors and bends: bright cards draw highlights on it, dark ones its outline.
    """

    direction: Vector
    """Towards its middle; any length."""
    size_deg: tuple[float, float]
    """Width and height as seen from the scene, each below 180."""
    radiance: Color
    roll_deg: float = 0.0
    """Turns it about its middle, anticlockwise as seen from the scene; at 0 its width is level."""
    softness_deg: float = 2.0
    """Width of its edge, over which it fades."""

    def __post_init__(self) -> None:
        check_positive("card direction", math.hypot(*self.direction))
        check_range("card radiance", self.radiance, 0, math.inf)
        if not all(0 < size < 180 for size in self.size_deg):
            raise HyalineError(f"card size_deg: is {self.size_deg}; expected two angles of more than 0 and below 180")
        if not math.isfinite(self.roll_deg):
            raise HyalineError(f"card roll_deg: is {self.roll_deg}; expected degrees")
        if not 0.2 <= self.softness_deg <= min(self.size_deg):
            raise HyalineError(
                f"card softness_deg: is {self.softness_deg}; expected 0.2 to {min(self.size_deg):g}, its narrow side"
            )


@dataclass(frozen=True, kw_only=True)
class SoftEnvironment:
    """Light from infinitely far: a smooth gradient over height, some lobes, and cards before these."""

    zenith: Color
    """Radiance from straight above (+z)."""
    horizon: Color
    ground: Color
    """Radiance from straight below."""
    lobes: tuple[Lobe, ...] = ()
    cards: tuple[Card, ...] = ()
    """Each covers those before it."""

    def __post_init__(self) -> None:
        for color in (self.zenith, self.horizon, self.ground):
            check_range("environment radiance", color, 0, math.inf)


@dataclass(frozen=True, kw_only=True)
class EnvironmentMap:
    """Light from infinitely far as a picture of all directions, in linear radiance.

    The picture is equirectangular: straight up (+z) is its first row, the middle column lies towards +x, and further
    to the right in it is further to the right for who looks at it from inside, towards -y.
    """

    path: str
    """Of an OpenEXR or Radiance file (.exr, .hdr) within the scene's folder."""
    scale: float = 1.0
    """Factor of the radiance."""
    rotation_deg: float = 0.0
    """Turns the light about the vertical, anticlockwise as seen from above: at 90 the middle column lies towards +y."""

    def __post_init__(self) -> None:
        check_relative(self.path, where="environment path")
        if not self.path.lower().endswith(MAP_ENDINGS):
            raise HyalineError(
                f"environment path: is {self.path!r}; expected an .exr or .hdr file inside the scene's folder"
            )
        check_positive("environment scale", self.scale)
        if not math.isfinite(self.rotation_deg):
            raise HyalineError(f"environment rotation_deg: is {self.rotation_deg}; expected degrees")


Environment = SoftEnvironment | EnvironmentMap


@dataclass(frozen=True, kw_only=True)
class RectangleLight:
    """A one-sided rectangle that shines along the cross product of its edges; seen by the camera, not peeled."""

    corner: Vector
    edge_u: Vector
    edge_v: Vector
    radiance: Color

    def __post_init__(self) -> None:
        check_range("light radiance", self.radiance, 0, math.inf)
