"""The scene that `--scene` means: a built-in or a random one, a folder, or a file from elsewhere."""

import dataclasses
from pathlib import Path

from hyaline_import.foreign_files import (
    DEFAULT_RESOLUTION,
    OTHER_ENDINGS,
    READERS,
    check_ending,
    ending_of,
)
from hyaline_random.names import RANDOM, parse_random

from datagen.data.config import Resolution
from datagen.data.meshes import is_there
from datagen.disk.errors import HyalineError
from datagen.scene.builtin import SCENES, find_builtin
from datagen.scene.description import Scene
from datagen.scene.folder import load_scene
from datagen.scene.import_choices import ImportChoices
from datagen.terminal.command import say, say_all


def is_foreign(given: str) -> bool:
    """True for a file of a format that is imported, by its ending."""
    ending = ending_of(Path(given))
    return ending != "" and ending in READERS.names() and not Path(given).is_dir()


def is_made_by_code(name: str) -> bool:
    """True for the name of a scene that can be made again from it: a built-in or a random one."""
    return name in SCENES or parse_random(name) is not None


def find_scene(
    given: str,
    *,
    built: Path | None = None,
    resolution: Resolution = DEFAULT_RESOLUTION,
    imports: ImportChoices = ImportChoices(),  # noqa: B008
) -> Scene:
    """The scene of a folder with a scene.json, of a file that is imported, or a built-in or random one by its name.

    Args:
        built: a dataset that may hold the same built-in scene, unwrapped.
        resolution: of the pictures, which the ground of an imported scene is made for.
        imports: how a file is imported.
    """
    if is_foreign(given):
        from hyaline_import.confined_import import imported_scene

        say(f"scene {given}: importing it")
        scene, told = imported_scene(Path(given), imports, resolution=resolution)
        say_all(told)
        return scene
    if flags := imports.given():
        raise HyalineError(f"{flags[0]}: goes with a file that is imported, such as --scene vase.glb; leave it out")
    ending = ending_of(Path(given))
    if ending in OTHER_ENDINGS or (ending not in ("", "json") and Path(given).is_file()):
        check_ending(Path(given))
    if (Path(given) / "scene.json").is_file():
        say(f"scene {given}: reading and checking it")
        scene = load_scene(Path(given))
        # That of an edit lists the objects that it removed.
        return dataclasses.replace(scene, objects=tuple(item for item in scene.objects if is_there(item.mesh)))
    if "/" in given:
        return load_scene(Path(given))
    if (random := parse_random(given)) is not None:
        from hyaline_random.drawing import make_random

        return make_random(random)
    if given.startswith(RANDOM):
        raise HyalineError(
            f"scene {given}: is not a random scene; expected a name like random-0007 or random-table-0007"
        )
    return find_builtin(given, built=built)
