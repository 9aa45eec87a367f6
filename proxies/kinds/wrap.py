"""Proxies of kind `wrap`: meshes that follow the object into its hollows, by PyMeshLab's alpha wrap.

A wrap is closed and encloses its object, even if that is open, in parts or a triangle soup: a glass keeps its bowl,
panes become slabs.
"""

import numpy as np

from datagen.data.meshes import Mesh, face_corners, vertex_normals
from proxies.meshing.meshlab import alpha_wrap
from proxies.meshing.solid import Solid, principal_directions
from proxies.meshing.surface import Surface, unwrap_sound

ALPHAS = (0.04, 0.08, 0.16)
"""Diameters of the ball that carves a wrap, relative to the diagonal: it does not enter narrower hollows.

The first whose triangles all get texels is used.
"""

OFFSET_OF_THICKNESS = 0.25
"""Distance of a wrap from its object, relative to the object's thickness, limited by `OFFSETS`."""

OFFSETS = (0.001, 0.01)
"""Least and greatest distance, relative to the diagonal: close wraps of sheets need tens of thousands of faces."""

CHARTED_THICKNESS = 0.2
"""Least thickness in the atlas layout, relative to the length, so that a slab's rim has texels."""


def fit_wraps(solids: tuple[Solid, ...], paddings: tuple[float, ...]) -> tuple[Mesh, ...]:
    """Each solid's alpha wrap, farther out by its padding."""
    return unwrap_sound(
        lambda index, place: wrapped(solids[index], padding=paddings[index], alpha=ALPHAS[place]),
        count=len(solids),
        places=len(ALPHAS),
    )


def wrapped(solid: Solid, *, padding: float, alpha: float) -> Surface:
    """The solid's alpha wrap; it is thicker in the atlas where it is thin."""
    low, high = solid.hull_points.min(axis=0), solid.hull_points.max(axis=0)
    center, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    offset = float(np.clip(OFFSET_OF_THICKNESS * solid.thickness / size, *OFFSETS)) + padding / size
    # In a box of diagonal 1 around the origin, where float32 is most precise.
    corners = (face_corners(solid.mesh).astype(np.float64) - center) / size
    vertices, faces = alpha_wrap(corners, alpha=alpha, offset=offset)
    vertices = vertices * size + center
    directions = principal_directions(solid.hull_points)
    along = vertices @ directions.T
    extents = np.ptp(along, axis=0)
    stretches = np.maximum(1, CHARTED_THICKNESS * extents.max() / extents)
    return Surface(
        vertices=vertices,
        faces=faces,
        normals=vertex_normals(vertices, faces),
        charted=along * stretches @ directions,
    )
