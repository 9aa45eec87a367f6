"""The built-in scenes: made by code, one file each, with the same bytes every time."""

import dataclasses
import importlib
from collections.abc import Callable

from datagen.data.metadata import OWN_LICENSE
from datagen.data.paths import BUILT_IN_SCENES
from datagen.scene.atlas import unwrap_all
from datagen.scene.description import Scene
from datagen.scene.soundness import check_scene
from datagen.terminal.command import choose, say


def _maker(name: str) -> Callable[[], Scene]:
    def make() -> Scene:
        return importlib.import_module(f"datagen.scene.builtin.{name}").make()

    return make


SCENES = {name: _maker(name) for name in BUILT_IN_SCENES}
"""Makers of the scenes, whose objects have no uv yet; each file is imported when its scene is made."""


def make_scene(name: str) -> Scene:
    """A built-in scene, unwrapped and checked."""
    make = SCENES[choose("scene", name, SCENES)]
    say(f"scene {name}: modelling it and unwrapping its surfaces")
    scene = make()
    meshes = unwrap_all({item.name: item.mesh for item in scene.objects})
    objects = tuple(dataclasses.replace(item, mesh=meshes[item.name]) for item in scene.objects)
    scene = dataclasses.replace(scene, objects=objects, license=OWN_LICENSE)
    check_scene(scene)
    return scene
