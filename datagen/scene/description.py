"""The renderer-neutral description of a scene (objects, lights, cameras) and its folder on disk."""

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import TypeVar, cast

from datagen.data.meshes import (
    Mesh,
    check_closed,
    check_mesh,
    count_shared_faces,
    is_there,
    no_mesh,
    read_ply,
    write_ply,
)
from datagen.disk.errors import HyalineError
from datagen.disk.names import check_name, find_file
from datagen.disk.reading import load_json
from datagen.disk.records import Json, from_json, shown, to_json
from datagen.disk.storage import commit, dump_json
from datagen.scene.materials import Material, check_material
from datagen.scene.media import MAX_NESTED
from datagen.scene.textures import ImageTexture
from datagen.scene.values import Color, Vector, check_positive, check_range

Record = TypeVar("Record")
SCENE_VERSION = 1
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


def check_scene(scene: Scene, *, is_sealed: bool = False) -> None:
    """Refuses a scene that would crash a native library or be rendered silently wrong.

    Args:
        is_sealed: all of this was found well when the scene's dataset was begun; single numbers are looked at again.

    Raises:
        HyalineError: naming the object, the value and what was expected.
    """
    check_name(scene.name, where="scene name")
    _check_names(scene)
    if not any(is_there(item.mesh) for item in scene.objects):
        raise HyalineError(f"scene {scene.name}: all of its objects were removed; expected at least one that is there")
    for item in scene.objects:
        where = f"scene {scene.name}: object {item.name}"
        if not is_there(item.mesh):
            continue
        check_mesh(item.mesh, where=where)
        if item.material.medium is not None:
            check_closed(item.mesh, where=where)
    _check_nesting(scene)
    if not is_sealed:
        from datagen.scene.soundness import check_sound

        check_sound(scene)


def _check_names(scene: Scene) -> None:
    """Refuses too many objects, and names that stand for nothing or for two things."""
    if not 1 <= len(scene.objects) <= MAX_OBJECTS:
        raise HyalineError(f"scene {scene.name}: has {len(scene.objects)} objects; expected 1 to {MAX_OBJECTS}")
    names = [item.name for item in scene.objects]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise HyalineError(f"scene {scene.name}: two objects are called {repeated[0]!r}; expected unique names")
    for name in names:
        if not re.fullmatch(OBJECT_NAME, name):
            raise HyalineError(f"scene {scene.name}: object name {name!r}; expected letters, digits, _ and -")


def _check_nesting(scene: Scene) -> None:
    """Refuses dielectrics of which nobody could say which fills the space: too many for priorities, or coincident."""
    there = [item for item in scene.objects if is_there(item.mesh)]
    glass = [(item, medium) for item in there if (medium := item.material.medium) is not None]
    if len(glass) > MAX_NESTED and len({medium.priority for _, medium in glass}) > 1:
        raise HyalineError(
            f"scene {scene.name}: has {len(glass)} dielectrics of different priority; expected at most {MAX_NESTED}, "
            "or the same priority for all and no overlaps"
        )
    for (one, _), (other, _) in combinations(glass, 2):
        if count := count_shared_faces(one.mesh, other.mesh):
            raise HyalineError(
                f"scene {scene.name}: objects {one.name} and {other.name} share {count} faces; "
                "let one reach into the other and give it the lower priority, or leave a gap"
            )


@dataclass(frozen=True, kw_only=True)
class _ObjectFile:
    name: str
    mesh: str | None
    """Relative to the scene's folder; None where an edit removed the object."""
    material: Material


@dataclass(frozen=True, kw_only=True)
class _SceneFile:
    version: int
    name: str
    description: str = ""
    objects: tuple[_ObjectFile, ...]
    environment: SoftEnvironment
    lights: tuple[RectangleLight, ...] = ()
    cameras: CameraRig


def save_scene(scene: Scene, folder: Path) -> None:
    """Writes `scene.json`, `meshes/*.ply` and image textures; `load_scene` gives the same scene back."""
    for relative, data in scene_files(scene).items():
        commit(folder / relative, data)


def scene_files(scene: Scene) -> dict[str, bytes]:
    """The files of a scene's folder, by relative path; equal scenes give equal bytes."""
    files: dict[str, bytes] = {}
    listed = []
    for item in scene.objects:
        mesh = f"meshes/{item.name}.ply" if is_there(item.mesh) else None
        if mesh is not None:
            files[mesh] = write_ply(item.mesh)
        listed.append(_ObjectFile(name=item.name, mesh=mesh, material=item.material))
        for image in item.material.images().values():
            files[image.path] = image_bytes(scene, image)
    file = _SceneFile(
        version=SCENE_VERSION,
        name=scene.name,
        description=scene.description,
        objects=tuple(listed),
        environment=scene.environment,
        lights=scene.lights,
        cameras=scene.cameras,
    )
    # Through the parser and back, so that 1 and 1.0 give the same bytes.
    canonical = from_json(_SceneFile, to_json(file), where=f"scene {scene.name}")
    data = cast(dict[str, Json], to_json(canonical))
    for listed_object in cast(list[dict[str, dict[str, Json]]], data["objects"]):
        # A key that came later stands only where it says something: the scenes of older datasets keep their bytes.
        if listed_object["material"].get("priority") == 0:
            del listed_object["material"]["priority"]
        color = listed_object["material"].get("color")
        if isinstance(color, dict) and color.get("origin") == [0.0, 0.0, 0.0]:
            del color["origin"]
    return {**files, "scene.json": dump_json(data)}


def load_scene(folder: Path, *, is_sealed: bool = False) -> Scene:
    """The checked scene in a folder. Objects without an atlas get one; what is mended is said in a line each.

    Args:
        is_sealed: the folder is a dataset's, whose scene was mended and checked when it was begun: read as it stands.

    Raises:
        HyalineError: a missing file, an unknown key, a bad value or a bad mesh.
    """
    path = find_file(folder, "scene.json", where=str(folder))
    data = load_json(path)
    if data.get("version") != SCENE_VERSION:
        raise HyalineError(f"{path}: version {shown(data.get('version'))}; this program reads version {SCENE_VERSION}")
    listed = data.get("objects")
    if isinstance(listed, list) and len(listed) > MAX_OBJECTS:
        raise HyalineError(f"{path}: has {len(listed):,} objects; expected at most {MAX_OBJECTS}")
    file = _parse_scene(data, path)
    objects, without_uv = [], set()
    for item in file.objects:
        mesh, has_uv = no_mesh(), True
        if item.mesh is not None:
            mesh, has_uv = read_ply(find_file(folder, item.mesh, where=f"{path}: object {item.name}"))
        if not has_uv:
            without_uv.add(item.name)
        for image in item.material.images().values():
            texture = find_file(folder, image.path, where=f"{path}: object {item.name}")
            if not texture.is_file():
                raise HyalineError(f"{texture}: the texture of object {item.name} is missing")
        objects.append(SceneObject(name=item.name, mesh=mesh, material=item.material))
    scene = Scene(
        name=file.name,
        description=file.description,
        objects=tuple(objects),
        environment=file.environment,
        lights=file.lights,
        cameras=file.cameras,
        folder=folder,
    )
    if not is_sealed:
        from datagen.scene.mending import mend_scene

        _check_names(scene)
        scene = mend_scene(scene, without_uv=without_uv)
    check_scene(scene, is_sealed=is_sealed)
    return scene


def _parse_scene(data: dict[str, Json], path: Path) -> _SceneFile:
    """The parsed scene.json; an error about an object names the object."""
    listed, objects = data.get("objects"), ()
    if isinstance(listed, list):
        objects = tuple(
            _parse_in(_ObjectFile, entry, where=f"{path}: {_name_in_errors(entry, index)}")
            for index, entry in enumerate(listed)
        )
        data = {**data, "objects": []}
    return dataclasses.replace(_parse_in(_SceneFile, data, where=str(path)), objects=objects)


def _parse_in(kind: type[Record], data: Json, *, where: str) -> Record:
    """`from_json`, whose errors all begin with `where`: records check their own values and cannot know their place."""
    try:
        return from_json(kind, data, where=where)
    except HyalineError as error:
        raise error if str(error).startswith(where) else HyalineError(f"{where}: {error}") from error


def _name_in_errors(entry: Json, index: int) -> str:
    name = entry.get("name") if isinstance(entry, dict) else None
    return f"object {name}" if isinstance(name, str) and re.fullmatch(OBJECT_NAME, name) else f"objects[{index}]"
