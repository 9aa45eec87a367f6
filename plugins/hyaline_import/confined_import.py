"""Imports as commands make them: in a process that a hostile file may hang or end, and into a folder of ours."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import cast

from datagen.data.config import Resolution
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import FolderKind, begin, holding, is_ours, refuse_others
from datagen.disk.records import Json, dump_json, load_json
from datagen.disk.storage import commit
from datagen.machine.processes import confined
from datagen.scene.description import EnvironmentMap, Scene
from datagen.scene.finding import ImportChoices
from datagen.scene.folder import load_scene, save_scene, scene_files
from hyaline_import.importing import import_scene

RECORD = "import.json"
IMPORTED = FolderKind(what="imported scene", head=RECORD, folders=("meshes", "textures", "baked"))


def imported_scene(
    path: Path, choices: ImportChoices, *, resolution: Resolution
) -> tuple[Scene, list[str], dict[str, Json]]:
    """The scene in a foreign file, the lines to report, and the content of import.json."""
    return scene_from(_import, path, choices, resolution, where=str(path))


def _import(folder: Path, path: Path, choices: ImportChoices, resolution: Resolution) -> None:
    imported = import_scene(path, choices, resolution=resolution)
    save_answer(folder, imported.scene, imported.told(), record=imported.record)


def scene_from(
    function: Callable[..., None], *arguments: object, where: str
) -> tuple[Scene, list[str], dict[str, Json]]:
    """The scene with its images, lines to report, and the record that a function gives `save_answer` in its process."""
    with confined(function, *arguments, where=where) as folder:
        # The process has mended and checked it.
        scene = load_scene(folder / "scene", is_checked=True)
        images = {image.path for item in scene.objects for image in item.material.images().values()}
        if isinstance(scene.environment, EnvironmentMap):
            images.add(scene.environment.path)
        baked = {image: (folder / "scene" / image).read_bytes() for image in images}
        answer = load_json(folder / "told.json")
    scene = dataclasses.replace(scene, folder=None, baked=baked)
    return scene, cast(list[str], answer["told"]), cast(dict[str, Json], answer["record"])


def save_answer(folder: Path, scene: Scene, told: Sequence[str], *, record: Mapping[str, Json] | None = None) -> None:
    """What `scene_from` reads."""
    save_scene(scene, folder / "scene")
    (folder / "told.json").write_bytes(dump_json({"told": list(told), "record": dict(record or {})}))


def check_free(root: Path) -> None:
    """Refuses a folder that is not empty, before any work is done."""
    if is_ours(root, IMPORTED):
        raise HyalineError(f"{root}: holds an imported scene; remove it, or choose another --out")
    refuse_others(root, IMPORTED)


def write_imported(scene: Scene, record: Mapping[str, Json], root: Path) -> None:
    """Writes a scene's files and the record of its import into a new or empty folder."""
    files = scene_files(scene)
    with holding(root, IMPORTED):
        check_free(root)
        begin(root, IMPORTED, dict(record))
        # A killed command leaves no scene, since scene.json is written last.
        for path in sorted(files, key=lambda path: (path == "scene.json", path)):
            commit(root / path, files[path])
