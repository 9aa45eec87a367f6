"""The renderer-neutral description of a scene (objects, lights, cameras)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.disk.names import find_file
from datagen.scene.materials import Material, check_material
from datagen.scene.textures import ImageTexture
from datagen.scene.values import Color, Vector, check_positive, check_range

OBJECT_NAME = r"[A-Za-z0-9_][A-Za-z0-9_-]*"
MAX_OBJECTS = 255
"""Object ids are 8 bits; 0 means empty."""


# Lights


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
class SoftEnvironment:
    """Light from infinitely far: a smooth gradient over height and some lobes."""

    zenith: Color
    """Radiance from straight above (+z)."""
    horizon: Color
    ground: Color
    """Radiance from straight below."""
    lobes: tuple[Lobe, ...] = ()

    def __post_init__(self) -> None:
        for color in (self.zenith, self.horizon, self.ground):
            check_range("environment radiance", color, 0, math.inf)


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
    objects: tuple[SceneObject, ...]
    environment: SoftEnvironment
    lights: tuple[RectangleLight, ...] = ()
    cameras: CameraRig
    folder: Path | None = field(default=None)
    """Where image textures lie; None for scenes made by code."""
    baked: Mapping[str, bytes] = field(default_factory=dict)
    """PNG files of image textures that were baked into another uv, by path; they lie in no folder yet."""


def image_bytes(scene: Scene, image: ImageTexture) -> bytes:
    """The file of an image texture."""
    if image.path in scene.baked:
        return scene.baked[image.path]
    assert scene.folder is not None, "a scene with images has a folder"
    return find_file(scene.folder, image.path, where=f"scene {scene.name}").read_bytes()
