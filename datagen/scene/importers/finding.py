"""The scene that `--scene` means: a built-in one, a folder, or a file from elsewhere."""

from pathlib import Path

from datagen.scene.builtin import find_builtin
from datagen.scene.description import Scene
from datagen.scene.folder import load_scene
from datagen.scene.importers.choices import ImportChoices
from datagen.scene.importers.importing import READERS, import_scene
from datagen.terminal.command import say


def is_foreign(given: str) -> bool:
    """True for a file of a format that is imported, by its ending."""
    return Path(given).suffix.lower() in READERS and not Path(given).is_dir()


def find_scene(given: str, *, built: Path | None = None, resolution: int = 128) -> Scene:
    """The scene of a folder with a scene.json, of a file that is imported, or a built-in one by its name.

    Args:
        built: a dataset that may hold the same built-in scene, unwrapped.
        resolution: of the pictures, which the ground of an imported scene is made for.

    Raises:
        HyalineError: none of these, or the scene is bad.
    """
    if is_foreign(given):
        say(f"scene {given}: imports it")
        imported = import_scene(Path(given), ImportChoices(resolution=resolution))
        for line in imported.told():
            say(line)
        return imported.scene
    if (Path(given) / "scene.json").is_file():
        say(f"scene {given}: reads and checks it")
        return load_scene(Path(given))
    if "/" in given:
        return load_scene(Path(given))
    return find_builtin(given, built=built)
