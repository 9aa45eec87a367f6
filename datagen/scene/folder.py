"""A scene's folder on disk: scene.json, meshes/*.ply and image textures."""

import dataclasses
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, cast

from datagen.data.config import SPLITS
from datagen.data.dataset import Dataset
from datagen.data.geometries import read_materials
from datagen.data.meshes import is_there, no_mesh
from datagen.data.paths import TRUTH, geometry_root
from datagen.data.ply import read_ply, write_ply
from datagen.data.transforms import TRANSFORMS_FILES, parse_transforms, transforms_bytes
from datagen.disk.errors import HyalineError, shown
from datagen.disk.records import MAX_JSON_BYTES, Json, dump_json, from_json, load_json, to_json
from datagen.disk.storage import check_files, commit, find_file, read_regular
from datagen.scene.description import (
    MAX_OBJECTS,
    OBJECT_NAME,
    CameraList,
    CameraRig,
    Environment,
    EnvironmentMap,
    RectangleLight,
    Scene,
    SceneObject,
    SoftEnvironment,
    image_bytes,
)
from datagen.scene.materials import Material
from datagen.scene.mending import assemble
from datagen.scene.soundness import check_scene

Record = TypeVar("Record")
SCENE_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class _ObjectFile:
    """An object: the unit that has an id in layers, a neural texture and a proxy."""

    name: str
    mesh: str | None
    """PLY file, relative to the scene's folder; null if an edit removed the object."""
    material: Material


@dataclass(frozen=True, kw_only=True)
class _SceneFile:
    """The contents of scene.json."""

    version: int
    name: str
    description: str = ""
    license: str | None = None
    """License of meshes, images and datasets made from them: an SPDX name such as CC-BY-4.0, or a line of text."""
    objects: tuple[_ObjectFile, ...]
    environment: Environment
    lights: tuple[RectangleLight, ...] = ()
    cameras: CameraRig | None = None
    """None: transforms_train.json, transforms_test.json and transforms_extrapolating.json list them, beside this file
    or, in a dataset, beside its folder."""


def save_scene(scene: Scene, folder: Path) -> None:
    """Writes `scene.json`, `meshes/*.ply` and image textures; `load_scene` returns the same scene."""
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
    if isinstance(scene.environment, EnvironmentMap):
        files[scene.environment.path] = image_bytes(scene, scene.environment)
    file = _SceneFile(
        version=SCENE_VERSION,
        name=scene.name,
        description=scene.description,
        license=scene.license,
        objects=tuple(listed),
        environment=scene.environment,
        lights=scene.lights,
        cameras=scene.cameras if isinstance(scene.cameras, CameraRig) else None,
    )
    if isinstance(scene.cameras, CameraList):
        for split in SPLITS:
            bare = dataclasses.replace(scene.cameras.of(split), near=None, far=None)
            files[TRANSFORMS_FILES[split]] = transforms_bytes(bare, split)
    # Parsed and written again, so that 1 and 1.0 give the same bytes.
    canonical = from_json(_SceneFile, to_json(file), where=f"scene {scene.name}")
    data = cast(dict[str, Json], to_json(canonical))
    if scene.license is None:
        del data["license"]  # Scenes without a license keep the bytes they had before the key existed.
    if file.cameras is None:
        del data["cameras"]
    return {**files, "scene.json": dump_json(data)}


def open_scene(dataset: Dataset, geometry: str = TRUTH) -> Scene:
    """A dataset's scene, every file of it verified; objects have the materials that they have in a geometry.

    Their meshes stay the scene's.
    """
    dataset = dataset.home
    check_files(dataset.root, {file: promised for file, promised in dataset.files.items() if file.startswith("scene/")})
    scene = load_scene(dataset.root / "scene", is_checked=True, cameras=lambda: listed_cameras(dataset))
    where = f"{geometry_root(dataset.root, geometry) / 'proxies.json'}: materials"
    materials = {
        name: cast(Material, from_json(cast(type, Material), value, where=f"{where}: {name}"))
        for name, value in read_materials(dataset, geometry).items()
    }
    return with_materials(scene, materials)


def listed_cameras(dataset: Dataset) -> CameraList:
    """The cameras of a dataset, or of the one around a variant, one by one."""
    owner = dataset.parent or dataset
    return CameraList(**{split: owner.cameras(split) for split in SPLITS})


def read_camera_list(folder: Path) -> CameraList:
    """The cameras that lie in a scene's folder, or in the dataset around it."""
    # A dataset has them beside scene/; its variants/NAME/, beside whose scene/ are none for training, has its cameras.
    around = [place for place in list(folder.parents)[:3] if (place / "dataset.json").is_file()]
    inside = [place for place in (folder, *around) if (place / TRANSFORMS_FILES["train"]).is_file()]
    if not inside:
        raise HyalineError(
            f"{folder / 'scene.json'}: has no cameras; expected `cameras` there, or "
            f"{', '.join(TRANSFORMS_FILES[split] for split in SPLITS)} beside it"
        )
    paths = {split: find_file(inside[0], TRANSFORMS_FILES[split], where=str(inside[0])) for split in SPLITS}
    return CameraList(
        **{
            split: parse_transforms(read_regular(path, at_most=MAX_JSON_BYTES), where=str(path))
            for split, path in paths.items()
        }
    )


def load_scene(folder: Path, *, is_checked: bool = False, cameras: Callable[[], CameraList] | None = None) -> Scene:
    """The checked scene in a folder. Objects without an atlas get one; each repair prints a line.

    Args:
        is_checked: the scene was repaired and checked when it was saved: read it unchanged.
        cameras: those of a scene that lists them; by default the ones in its folder, or in the dataset around it.
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
        objects.append(SceneObject(name=item.name, mesh=mesh, material=item.material))
    scene = Scene(
        name=file.name,
        description=file.description,
        license=file.license,
        objects=tuple(objects),
        environment=file.environment,
        lights=file.lights,
        cameras=file.cameras or (read_camera_list(folder) if cameras is None else cameras()),
        folder=folder,
    )
    if not is_checked:
        return assemble(scene, without_uv=without_uv)
    check_scene(scene, is_checked=True)
    return scene


def with_materials(scene: Scene, materials: Mapping[str, Material]) -> Scene:
    """The scene with other materials of some objects, by name."""
    objects = [
        dataclasses.replace(item, material=materials[item.name]) if item.name in materials else item
        for item in scene.objects
    ]
    return dataclasses.replace(scene, objects=tuple(objects))


def _parse_scene(data: dict[str, Json], path: Path) -> _SceneFile:
    """The parsed scene.json; an error about an object names the object."""
    listed, objects = data.get("objects"), ()
    if isinstance(listed, list):
        objects = tuple(
            _parse_in(_ObjectFile, entry, where=f"{path}: {_name_in_errors(entry, index)}")
            for index, entry in enumerate(listed)
        )
        data = {**data, "objects": []}
    for key, first in (("environment", SoftEnvironment), ("cameras", CameraRig)):
        if isinstance(described := data.get(key), dict):  # Old files have no type: there was only one kind.
            data = {**data, key: {"type": first.__name__, **described}}
    return dataclasses.replace(_parse_in(_SceneFile, data, where=str(path)), objects=objects)


def _parse_in(kind: type[Record], data: Json, *, where: str) -> Record:
    """`from_json` with `where` before every error: records check their own values and do not know their place."""
    try:
        return from_json(kind, data, where=where)
    except HyalineError as error:
        if str(error).startswith(where):
            raise
        raise HyalineError(f"{where}: {error}") from error


def _name_in_errors(entry: Json, index: int) -> str:
    name = entry.get("name") if isinstance(entry, dict) else None
    return f"object {name}" if isinstance(name, str) and re.fullmatch(OBJECT_NAME, name) else f"objects[{index}]"
