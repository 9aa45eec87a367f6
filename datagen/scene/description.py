"""The renderer-neutral description of a scene (objects, lights, cameras)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.disk.names import find_file
from datagen.disk.records import read_regular
from datagen.scene.camera_list import CameraList
from datagen.scene.lights import Card, Environment, EnvironmentMap, Lobe, RectangleLight, SoftEnvironment
from datagen.scene.materials import Material, check_material
from datagen.scene.textures import ImageTexture
from datagen.scene.values import Vector, check_positive

__all__ = [
    "MAX_OBJECTS",
    "OBJECT_NAME",
    "CameraList",
    "CameraRig",
    "Card",
    "EnvironmentMap",
    "Lobe",
    "RectangleLight",
    "Scene",
    "SceneObject",
    "SoftEnvironment",
    "WalkPoint",
    "image_bytes",
]

OBJECT_NAME = r"[A-Za-z0-9_][A-Za-z0-9_-]*"
MAX_OBJECTS = 255
"""Object ids are 8 bits; 0 means empty."""


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
