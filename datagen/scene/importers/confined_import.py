"""Imports as commands make them: in a process of its own, which a hostile file may hang or end."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from datagen.data.resolution import Resolution
from datagen.disk.reading import load_json
from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from datagen.machine.confined import confined
from datagen.scene.description import Scene
from datagen.scene.folder import load_scene, save_scene
from datagen.scene.importers.choices import ImportChoices
from datagen.scene.importers.importing import import_scene
from datagen.scene.lights import EnvironmentMap


@dataclass(frozen=True, kw_only=True, eq=False)
class ImportedFiles:
    """The files of an imported scene's folder by their path, what import.json says, and what a user is told."""

    files: Mapping[str, bytes]
    record: Mapping[str, Json]
    told: list[str]


def import_files(path: Path, choices: ImportChoices, *, resolution: Resolution) -> ImportedFiles:
    """The folder of the scene in a foreign file.

    Raises:
        HyalineError: see `import_scene` and `confined`.
    """
    with confined(_import, path, choices, resolution, where=str(path)) as folder:
        scene = folder / "scene"
        files = {file.relative_to(scene).as_posix(): file.read_bytes() for file in scene.rglob("*") if file.is_file()}
        answer = load_json(folder / "told.json")
    record, told = cast(dict[str, Json], answer["record"]), cast(list[str], answer["told"])
    return ImportedFiles(files=files, record=record, told=told)


def imported_scene(path: Path, choices: ImportChoices, *, resolution: Resolution) -> tuple[Scene, list[str]]:
    """The scene in a foreign file, and what a user is told."""
    with scene_from(_import, path, choices, resolution, where=str(path)) as (scene, folder):
        return scene, cast(list[str], load_json(folder / "told.json")["told"])


@contextmanager
def scene_from(function: Callable[..., None], *arguments: object, where: str) -> Iterator[tuple[Scene, Path]]:
    """The scene that a function saves in `folder/scene` in a process of its own, with its images; and that folder."""
    with confined(function, *arguments, where=where) as folder:
        # The process has mended and checked it.
        scene = load_scene(folder / "scene", is_sealed=True)
        images = {image.path for item in scene.objects for image in item.material.images().values()}
        if isinstance(scene.environment, EnvironmentMap):
            images.add(scene.environment.path)
        baked = {image: (folder / "scene" / image).read_bytes() for image in images}
        yield dataclasses.replace(scene, folder=None, baked=baked), folder


def _import(folder: Path, path: Path, choices: ImportChoices, resolution: Resolution) -> None:
    imported = import_scene(path, choices, resolution=resolution)
    save_scene(imported.scene, folder / "scene")
    told: dict[str, Json] = {"record": dict(imported.record), "told": cast(list[Json], imported.told())}
    (folder / "told.json").write_bytes(dump_json(told))
