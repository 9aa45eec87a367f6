"""Where an object stands: a transform in scene.json, applied when the scene is read."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.scene.materials import Material
from datagen.scene.values import Vector, as_vector, check_positive


@dataclass(frozen=True, kw_only=True)
class Transform:
    """Scales a mesh about its own origin, turns it, and then moves it."""

    scale: Vector = (1.0, 1.0, 1.0)
    """Factors along the mesh's own x, y and z."""
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    """About the world's x, then y, then z axis; anticlockwise for who looks against the axis."""
    translation: Vector = (0.0, 0.0, 0.0)
    """Metres."""

    def __post_init__(self) -> None:
        for factor in self.scale:
            check_positive("transform scale", factor)
        for name, values in (("rotation_deg", self.rotation_deg), ("translation", self.translation)):
            if not all(map(math.isfinite, values)):
                raise HyalineError(f"transform {name}: is {values}; expected three numbers")

    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """World from object, without scale."""
        turned = np.eye(3)
        for axis, angle in enumerate(np.radians(self.rotation_deg)):
            one, other = (axis + 1) % 3, (axis + 2) % 3
            about = np.eye(3)
            about[[one, other], [one, other]] = np.cos(angle)
            about[one, other], about[other, one] = -np.sin(angle), np.sin(angle)
            turned = about @ turned
        return turned


def transformed(mesh: Mesh, transform: Transform) -> Mesh:
    """The mesh where the transform puts it; its uv stay."""
    rotation, scale = transform.rotation(), np.array(transform.scale)
    vertices = (mesh.vertices.astype(np.float64) * scale) @ rotation.T + transform.translation
    # Normals shrink where the surface is stretched.
    normals = (mesh.normals.astype(np.float64) / scale) @ rotation.T
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return dataclasses.replace(mesh, vertices=vertices.astype(np.float32), normals=normals.astype(np.float32))


def transformed_material(material: Material, transform: Transform) -> Material:
    """The material of a transformed object: a pattern carved from space begins where its origin has gone.

    Its directions and its scale stay those of the world.
    """
    for name, pattern in material.solids().items():
        place = transform.rotation() @ (np.array(transform.scale) * pattern.origin) + transform.translation
        material = material.with_fields({name: dataclasses.replace(pattern, origin=as_vector(place))})
    return material
