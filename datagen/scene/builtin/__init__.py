"""The built-in scenes: made by code, one file each, with the same bytes every time."""

import dataclasses
import importlib

import numpy as np

from datagen.data.config import OWN_LICENSE
from datagen.data.meshes import Mesh
from datagen.data.paths import BUILT_IN_SCENES
from datagen.scene.description import Scene, SceneObject, WalkPoint
from datagen.scene.materials import Material, Vector
from datagen.scene.mending import assemble
from datagen.scene.modelling import Point, moved, resting, rounded_box, transformed
from datagen.terminal.command import choose, say


def make_scene(name: str) -> Scene:
    """A built-in scene, unwrapped and checked."""
    description = BUILT_IN_SCENES[choose("scene", name, BUILT_IN_SCENES)]
    say(f"scene {name}: modelling it and unwrapping its surfaces")
    scene: Scene = importlib.import_module(f"datagen.scene.builtin.{name}").make()
    return assemble(dataclasses.replace(scene, description=description, license=OWN_LICENSE))


# What the scenes are furnished with


GAP = 0.001
"""Metres between touching objects: coincident faces lose layers."""


def walk_along(*points: tuple[Vector, Vector]) -> tuple[WalkPoint, ...]:
    """Camera positions and their targets as the key points of a walk."""
    return tuple(WalkPoint(position=position, target=target) for position, target in points)


def slab(name: str, size: Point, center: Point, material: Material, *, bevel: float = 0.004) -> SceneObject:
    """A floor, wall, board or picture: a box with slightly rounded edges."""
    return SceneObject(name=name, mesh=moved(rounded_box(size, bevel=bevel), center), material=material)


def put_on(height: float, name: str, mesh: Mesh, material: Material, x: float, y: float) -> SceneObject:
    """An object at (x, y) with its lowest point a gap above a surface."""
    return SceneObject(name=name, mesh=resting(mesh, (x, y, height + GAP)), material=material)


def put_enlarged(
    scale: float, height: float, name: str, mesh: Mesh, material: Material, x: float, y: float
) -> SceneObject:
    """An object modelled on z = 0, enlarged and put on a surface at (x, y)."""
    return SceneObject(name=name, mesh=transformed(mesh, scale * np.eye(3), (x, y, height + GAP)), material=material)
