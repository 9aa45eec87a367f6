"""The scene that a word means: a built-in one, a folder, or one of a plug-in."""

import dataclasses
from pathlib import Path

from datagen.data.config import Resolution, square
from datagen.data.meshes import is_there
from datagen.disk.errors import HyalineError, UsageError
from datagen.scene.builtin import make_scene
from datagen.scene.description import Scene
from datagen.scene.folder import load_scene
from datagen.scene.import_choices import ImportChoices
from datagen.scene.sources import SOURCES, SceneSource
from datagen.terminal.command import say

DEFAULT_RESOLUTION = square(128)


def find_source(given: str, *, is_of_files: bool) -> SceneSource | None:
    """The source of a scene, if one has it."""
    sources = (SOURCES.find(name) for name in SOURCES.names())
    return next((source for source in sources if source.is_of_files is is_of_files and source.has(given)), None)


def numbered_scenes(given: str) -> SceneSource | None:
    """The source that numbers its scenes, if that is what a word means: `random`."""
    source = SOURCES.find(given) if given in SOURCES.names() else None
    return source if source is not None and source.name_of is not None else None


def is_foreign(given: str) -> bool:
    """True for a file that is imported."""
    return find_source(given, is_of_files=True) is not None


def find_scene(
    given: str,
    *,
    resolution: Resolution = DEFAULT_RESOLUTION,
    imports: ImportChoices = ImportChoices(),  # noqa: B008
) -> Scene:
    """The scene of a folder with a scene.json, a built-in one by its name, or one of a plug-in.

    Args:
        resolution: of the pictures, which the ground of an imported scene is made for.
        imports: how a file is imported.
    """
    if (source := find_source(given, is_of_files=True)) is not None:
        return source.find(given, resolution, imports)
    if flags := imports.given():
        raise HyalineError(f"{flags[0]}: goes with a file that is imported, such as vase.glb; leave it out")
    if Path(given).is_file() and Path(given).name != "scene.json":
        raise UsageError(f"{given}: reading files needs the plug-in hyaline_import, which is not installed here")
    if (Path(given) / "scene.json").is_file():
        say(f"scene {given}: reading and checking it")
        scene = load_scene(Path(given))
        # That of an edit lists the objects that it removed.
        return dataclasses.replace(scene, objects=tuple(item for item in scene.objects if is_there(item.mesh)))
    if "/" in given:
        return load_scene(Path(given))
    if (source := find_source(given, is_of_files=False)) is not None:
        return source.find(given, resolution, imports)
    return make_scene(given)
