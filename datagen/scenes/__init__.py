"""Owns the list of built-in scenes: all made by code, one file each, the same bytes every time."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from datagen.atlas import unwrap_all
from datagen.command import choose
from datagen.scene import Scene, check_scene, load_scene
from datagen.scenes import drinks, glass_table, plant_shelf, vitrine

SCENES: dict[str, Callable[[], Scene]] = {
    "glass_table": glass_table.make,
    "vitrine": vitrine.make,
    "plant_shelf": plant_shelf.make,
    "drinks": drinks.make,
}
"""Makers of the scenes, whose objects have no uv yet."""


def make_scene(name: str) -> Scene:
    """A built-in scene, unwrapped and checked.

    Raises:
        HyalineError: there is none of that name.
    """
    scene = SCENES[choose("scene", name, SCENES)]()
    meshes = unwrap_all({item.name: item.mesh for item in scene.objects})
    objects = tuple(dataclasses.replace(item, mesh=meshes[item.name]) for item in scene.objects)
    scene = dataclasses.replace(scene, objects=objects)
    check_scene(scene)
    return scene


def find_scene(given: str) -> Scene:
    """The scene that `--scene` means: a folder with a scene.json, or the name of a built-in one.

    Raises:
        HyalineError: neither, or the folder's scene is bad.
    """
    if (Path(given) / "scene.json").is_file() or "/" in given:
        return load_scene(Path(given))
    return make_scene(given)


def describe_scenes() -> dict[str, str]:
    """One line about each built-in scene, by name."""
    return {name: make().description for name, make in SCENES.items()}
