"""Surfaces: closed triangle meshes that have no uv yet, and how they are unwrapped."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from datagen.data.meshes import Mesh
from datagen.scene.atlas import coverage, unwrap_all
from proxies.meshing.measure import ATLAS_ROOM, smallest_chart

COVERAGE_SIZE = 512
"""Texels a side of the atlas in which a chart must not fold over itself."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """A mesh before it is unwrapped."""

    vertices: Float64[np.ndarray, "vertex 3"]
    """Positions in metres; one that has several normals stands several times."""
    faces: Int64[np.ndarray, "face 3"]
    """Outward."""
    normals: Float64[np.ndarray, "vertex 3"]
    """Unit shading normals."""
    charted: Float64[np.ndarray, "vertex 3"]
    """The vertices in the space, any affine image of the world, whose areas the atlas keeps in proportion: where the
    object is thin, thin faces get texels in a space that makes it thicker."""


def unwrap_surfaces(surfaces: tuple[Surface, ...]) -> tuple[Mesh, ...]:
    """Each surface with a uv of its own for every point; vertices stand several times along the atlas's seams."""
    charted = unwrap_all(
        {
            f"proxy {index + 1} of {len(surfaces)}": Mesh(
                vertices=surface.charted.astype(np.float32),
                faces=surface.faces.astype(np.int32),
                normals=surface.normals.astype(np.float32),
                uv=np.zeros((len(surface.vertices), 2), np.float32),
            )
            for index, surface in enumerate(surfaces)
        }
    )
    return tuple(_laid_on(surface, mesh) for surface, mesh in zip(surfaces, charted.values(), strict=True))


def unwrap_sound(propose: Callable[[int, int], Surface], *, count: int, places: int) -> tuple[Mesh, ...]:
    """For each of `count` objects the first surface that xatlas lays out with texels for every face and without folds.

    xatlas 0.0.11 may fold a chart of large triangles, and squeeze small ones at sharp edges. Where no surface is laid
    out well, the first stands, and its check says what is wrong with it.

    Args:
        propose: the surface of an object at a place, from 0 to `places` - 1.
    """
    meshes: dict[int, Mesh] = {}
    unsound = list(range(count))
    for place in range(places):
        unwrapped = unwrap_surfaces(tuple(propose(index, place) for index in unsound))
        tried, unsound = unsound, []
        for index, mesh in zip(tried, unwrapped, strict=True):
            is_sound = smallest_chart(mesh) >= ATLAS_ROOM and coverage(mesh, COVERAGE_SIZE).max() <= 1
            if is_sound or index not in meshes:
                meshes[index] = mesh
            if not is_sound:
                unsound.append(index)
    return tuple(meshes[index] for index in range(count))


def _laid_on(surface: Surface, charted: Mesh) -> Mesh:
    """The surface with the atlas of its charted twin, whose faces are the same in the same order."""
    vertex_of = np.zeros(len(charted.vertices), np.int64)
    vertex_of[charted.faces] = surface.faces
    return Mesh(
        vertices=surface.vertices[vertex_of].astype(np.float32),
        faces=charted.faces,
        normals=surface.normals[vertex_of].astype(np.float32),
        uv=charted.uv,
    )
