"""The renderer-neutral description of a scene: lights, cameras, objects."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.disk.names import check_relative, find_file
from datagen.disk.reading import read_regular
from datagen.scene.camera_list import CameraList
from datagen.scene.materials import Material, check_material
from datagen.scene.textures import ImageTexture
from datagen.scene.values import Color, Vector, check_positive, check_range

OBJECT_NAME = r"[A-Za-z0-9_][A-Za-z0-9_-]*"
MAX_OBJECTS = 255
"""Object ids are 8 bits; 0 means empty."""


# Lights


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


# Cameras


@dataclass(frozen=True, kw_only=True)
class WalkPoint:
    """A place that the extrapolating walk passes, and where it looks from there."""

    position: Vector
    target: Vector


@dataclass(frozen=True, kw_only=True)
class CameraRig:
    """Where the cameras of all splits stand: a cropped hemisphere, and a walk that leaves it."""

    target: Vector
    """Centre of the hemisphere; its cameras look at points near it."""
    radius: float
    """Metres."""
    elevation_deg: tuple[float, float]
    """Lowest and highest elevation on the hemisphere, degrees above the horizon."""
    azimuth_deg: tuple[float, float] = (0.0, 360.0)
    """First and last azimuth, degrees from +x towards +y."""
    fov_deg: float = 40.0
    """Horizontal field of view."""
    target_jitter: float = 0.05
    """Training cameras look at target plus a uniform offset of up to this many radii per axis."""
    walk: tuple[WalkPoint, ...]
    """Key points of the extrapolating split, in order; at least two."""

    def __post_init__(self) -> None:
        check_positive("camera radius", self.radius)
        low, high = self.elevation_deg
        if not -90 < low <= high < 90:
            raise HyalineError(f"camera elevation_deg: is {self.elevation_deg}; expected -90 < low <= high < 90")
        if not 0 < self.fov_deg < 170:
            raise HyalineError(f"camera fov_deg: is {self.fov_deg}; expected 0 to 170")
        if len(self.walk) < 2:
            raise HyalineError(f"camera walk: has {len(self.walk)} points; expected at least 2")


# The scene


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneObject:
    """One object: what is peeled under one id, textured by one neural texture, replaced by one proxy."""

    name: str
    mesh: Mesh
    """Without faces where an edit removed the object: its id then stays unused, and all others keep theirs."""
    material: Material

    def __post_init__(self) -> None:
        check_material(self.material, where=f"object {self.name}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Everything that a path tracer needs, naming none. The id of `objects[i]` is i + 1."""

    name: str
    description: str = ""
    license: str | None = None
    """Of meshes and images, and so of what is rendered from them; None where nobody states it."""
    objects: tuple[SceneObject, ...]
    environment: Environment
    lights: tuple[RectangleLight, ...] = ()
    cameras: CameraRig | CameraList
    folder: Path | None = field(default=None)
    """Where image textures and the map of the environment lie; None for scenes made by code."""
    baked: Mapping[str, bytes] = field(default_factory=dict)
    """PNG files of image textures that were baked into another uv, by path; they lie in no folder yet."""


def image_bytes(scene: Scene, image: ImageTexture | EnvironmentMap) -> bytes:
    """The file of an image texture or of a map of the environment."""
    if image.path in scene.baked:
        return scene.baked[image.path]
    assert scene.folder is not None, "a scene with images has a folder"
    return read_regular(find_file(scene.folder, image.path, where=f"scene {scene.name}"))
