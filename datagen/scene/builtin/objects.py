"""Objects that the built-in scenes are furnished with: slabs for rooms and boards, and things put on a surface."""

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.description import SceneObject
from datagen.scene.materials import Material
from datagen.scene.modelling import Point, moved, resting, rounded_box, transformed

GAP = 0.001
"""Metres between touching objects: coincident faces lose layers."""


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
