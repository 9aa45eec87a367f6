"""The renderer-neutral description of a scene: lights, cameras, objects."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Cameras
from datagen.data.config import SPLITS, Split
from datagen.data.meshes import Mesh
from datagen.data.transforms import refuse_other_lens
from datagen.disk.errors import HyalineError
from datagen.disk.records import checked
from datagen.disk.storage import check_relative, find_file, read_regular
from datagen.scene.materials import Color, ImageTexture, Material, Vector, as_vector, check_positive, check_range

OBJECT_NAME = r"[A-Za-z0-9_][A-Za-z0-9_-]*"
MAX_OBJECTS = 255
"""Largest number of objects: ids have 8 bits, and 0 means empty."""


# Lights


MAP_ENDINGS = (".exr", ".hdr")
"""Endings of radiance files: OpenEXR, and Radiance's RGBE."""

MAX_SHARPNESS = 200_000
"""Of lobes. The map that they are painted into has the light of wider ones to 2 %, and loses that of sharper ones."""


@checked
@dataclass(frozen=True, kw_only=True)
class Lobe:
    """A soft round light in the sky: radiance falls off as exp(sharpness (cos angle - 1)).

    Sharpness 20 is about 30 degrees wide at half height; small lights cause fireflies behind glass.
    """

    direction: Vector
    """Direction towards the light; any length."""
    radiance: Color
    sharpness: float

    def __post_init__(self) -> None:
        check_positive("lobe direction", math.hypot(*self.direction))
        check_range("lobe radiance", self.radiance, 0, math.inf)
        if not 0 < self.sharpness <= MAX_SHARPNESS:
            raise HyalineError(f"lobe sharpness: is {self.sharpness}; expected above 0 and at most {MAX_SHARPNESS:,}")


@checked
@dataclass(frozen=True, kw_only=True)
class Card:
    """A rectangle that covers the sky behind it: a bright one acts as a photographer's softbox, a black one as a flag.

    Glass becomes visible by reflection and refraction: bright cards give it highlights, dark ones outlines.
    """

    direction: Vector
    """Direction towards its centre; any length."""
    size_deg: tuple[float, float]
    """Width and height as seen from the scene, each below 180 degrees."""
    radiance: Color
    roll_deg: float = 0.0
    """Rotation about its centre, anticlockwise as seen from the scene; at 0 its width is horizontal."""
    softness_deg: float = 2.0
    """Width of its edge, over which it fades out."""

    def __post_init__(self) -> None:
        check_positive("card direction", math.hypot(*self.direction))
        check_range("card radiance", self.radiance, 0, math.inf)
        if not all(0 < size < 180 for size in self.size_deg):
            raise HyalineError(f"card size_deg: is {self.size_deg}; expected two angles above 0 and below 180")
        if not 0.2 <= self.softness_deg <= min(self.size_deg):
            raise HyalineError(
                f"card softness_deg: is {self.softness_deg}; expected 0.2 to {min(self.size_deg):g}, its narrow side"
            )


@checked
@dataclass(frozen=True, kw_only=True)
class SoftEnvironment:
    """Light from infinitely far away: a smooth vertical gradient, lobes, and cards in front of them."""

    zenith: Color
    """Radiance from straight above (+z)."""
    horizon: Color
    ground: Color
    """Radiance from straight below."""
    lobes: tuple[Lobe, ...] = ()
    cards: tuple[Card, ...] = ()
    """Cards; each covers the ones listed before it."""

    def __post_init__(self) -> None:
        for color in (self.zenith, self.horizon, self.ground):
            check_range("environment radiance", color, 0, math.inf)


@checked
@dataclass(frozen=True, kw_only=True)
class EnvironmentMap:
    """Light from infinitely far away, as a picture of all directions in linear radiance.

    The picture is equirectangular: its first row is straight up (+z), its middle column is towards +x, and columns
    further right are further right as seen from the scene, towards -y.
    """

    path: str
    """OpenEXR or Radiance file (.exr, .hdr) in the scene's folder."""
    scale: float = 1.0
    """Factor on the radiance."""
    rotation_deg: float = 0.0
    """Rotation about the vertical, anticlockwise as seen from above: at 90 the middle column is towards +y."""

    def __post_init__(self) -> None:
        check_relative(self.path, where="environment path")
        if not self.path.lower().endswith(MAP_ENDINGS):
            raise HyalineError(
                f"environment path: is {self.path!r}; expected an .exr or .hdr file inside the scene's folder"
            )
        check_positive("environment scale", self.scale)


Environment = SoftEnvironment | EnvironmentMap


@checked
@dataclass(frozen=True, kw_only=True)
class RectangleLight:
    """A one-sided rectangle that emits along the cross product of its edges; visible to cameras, but not peeled."""

    corner: Vector
    edge_u: Vector
    edge_v: Vector
    radiance: Color

    def __post_init__(self) -> None:
        check_range("light radiance", self.radiance, 0, math.inf)
        if not np.linalg.norm(np.cross(self.edge_u, self.edge_v)) > 0:
            raise HyalineError(f"light edges: are {self.edge_u} and {self.edge_v}; expected two that span a rectangle")


# Cameras


@checked
@dataclass(frozen=True, kw_only=True)
class WalkPoint:
    """A point of the extrapolating walk, and where the camera looks from there."""

    position: Vector
    target: Vector


@checked
@dataclass(frozen=True, kw_only=True)
class CameraRig:
    """Placement of the cameras of all splits: a cropped hemisphere, and a walk that leaves it."""

    target: Vector
    """Centre of the hemisphere; its cameras look at points near it."""
    radius: float
    """Radius of the hemisphere in metres."""
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
        first, last = self.azimuth_deg
        if not first <= last <= first + 360:
            raise HyalineError(
                f"camera azimuth_deg: is {self.azimuth_deg}; expected first <= last <= first + 360, such as (350, 370)"
            )
        if not 0 < self.fov_deg < 170:
            raise HyalineError(f"camera fov_deg: is {self.fov_deg}; expected 0 to 170")
        if len(self.walk) < 2:
            raise HyalineError(f"camera walk: has {len(self.walk)} points; expected at least 2")


LEAST_GAP_DEG = 60.0
"""Degrees between neighbouring cameras on a circle; a wider gap may be there because something is in the way."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraList:
    """The cameras of each split, instead of a rig that places them; all have the same lens."""

    train: Cameras
    interpolating: Cameras
    """Test views among the training cameras."""
    extrapolating: Cameras
    """Test views away from the training cameras."""

    def __post_init__(self) -> None:
        for split in SPLITS:
            if not len(self.of(split)):
                raise HyalineError(f"cameras {split}: there are none; expected at least one")
            refuse_other_lens(self.of(split), self.train, where=f"cameras {split}")

    def of(self, split: Split) -> Cameras:
        """The cameras of one of the splits that every dataset has."""
        return {"train": self.train, "interpolating": self.interpolating, "extrapolating": self.extrapolating}[split]

    @property
    def target(self) -> Vector:
        """The point nearest to the axes of all training cameras."""
        place, ahead = self._axes()
        across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
        # If all cameras look the same way, every point along it is equally near; then it is the point 1 m ahead.
        tie = 1e-6 * np.eye(3)
        sums = across.sum(axis=0) + tie, np.einsum("vij,vj->i", across, place) + tie @ (place + ahead).mean(axis=0)
        return as_vector(np.linalg.solve(*sums))

    @property
    def radius(self) -> float:
        """Median distance of the training cameras from their target in metres."""
        return float(np.median(np.linalg.norm(self._axes()[0] - self.target, axis=1)))

    @property
    def elevation_deg(self) -> tuple[float, float]:
        """Lowest and highest training camera above the target's horizon."""
        elevation = np.degrees(np.arcsin(self._directions()[:, 2]))
        return float(elevation.min()), float(elevation.max())

    @property
    def azimuth_deg(self) -> tuple[float, float]:
        """First and last azimuth of the training cameras around the target, the widest gap left out."""
        directions = self._directions()
        azimuth = np.sort(np.degrees(np.arctan2(directions[:, 1], directions[:, 0])))
        gaps = np.diff(azimuth, append=azimuth[0] + 360)
        widest = int(np.argmax(gaps))
        if gaps[widest] < LEAST_GAP_DEG:
            return 0.0, 360.0
        first = float(azimuth[(widest + 1) % len(azimuth)])
        return first, first + 360 - float(gaps[widest])

    def _directions(self) -> Float[np.ndarray, "view 3"]:
        """From the target to the training cameras, of unit length."""
        away = self._axes()[0] - self.target
        return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)

    def _axes(self) -> tuple[Float[np.ndarray, "view 3"], Float[np.ndarray, "view 3"]]:
        matrices = self.train.world_from_camera
        return matrices[:, :3, 3], -matrices[:, :3, 2]


# The scene


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneObject:
    """An object: the unit that has an id in layers, a neural texture and a proxy."""

    name: str
    mesh: Mesh
    """The mesh; without faces if an edit removed the object, whose id then stays unused."""
    material: Material


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Everything that a path tracer needs, independent of any. The id of `objects[i]` is i + 1."""

    name: str
    description: str = ""
    license: str | None = None
    """License of meshes and images, and so of renderings; None if unknown."""
    objects: tuple[SceneObject, ...]
    environment: Environment
    lights: tuple[RectangleLight, ...] = ()
    cameras: CameraRig | CameraList
    folder: Path | None = field(default=None)
    """Folder of image textures and the environment map; None for scenes made by code."""
    baked: Mapping[str, bytes] = field(default_factory=dict)
    """PNG files of image textures baked into new uv, by path; not written to a folder yet."""


def image_bytes(scene: Scene, image: ImageTexture | EnvironmentMap) -> bytes:
    """The file of an image texture or an environment map."""
    if image.path in scene.baked:
        return scene.baked[image.path]
    assert scene.folder is not None, "a scene with images has a folder"
    return read_regular(find_file(scene.folder, image.path, where=f"scene {scene.name}"))
