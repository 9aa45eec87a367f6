"""The inner sides of vessels, which the page moves to make their walls thinner or thicker."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from datagen.data.meshes import Mesh, is_there, open_edges
from datagen.machine.mitsuba_variant import use_mitsuba

DIRECTIONS, MOST_OPEN = 16, 1
"""Most horizontal directions that may lead out of a vessel from a point inside it."""

LEAST_PART = 0.1
"""Part of a mesh's vertices that lie inside a vessel."""

THICKEST = 2.0
"""Times the median: what is thicker, such as the stem below a bowl, grows no faster than that."""

BESIDE = 1e-5
"""Distance from the surface of where rays start, times the mesh's size."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Wall:
    """The wall of a vessel."""

    thickness: float
    """Median over its sides, metres."""
    shifts: Float32[np.ndarray, "vertex 3"]
    """By how much each vertex moves where the wall becomes twice as thick; 0 outside."""


def find_wall(mesh: Mesh) -> Wall | None:
    """The wall of a closed mesh that has an inner side; None for solid glass."""
    use_mitsuba()
    from datagen.trace.peel import Peeler

    if not is_there(mesh) or open_edges(mesh):
        return None
    peeler = Peeler((mesh,))
    # Vertices on a seam of the atlas move as one.
    places, first, of = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    normals = np.zeros((len(first), 3))
    np.add.at(normals, of.ravel(), mesh.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    beside = BESIDE * float(np.ptp(mesh.vertices, axis=0).max())

    def distances(side: int, directions: Float64[np.ndarray, "place 3"]) -> Float32[np.ndarray, " place"]:
        """To the mesh from its outer (1) or inner (-1) side; infinite where it is not met."""
        hits = peeler.trace((places + side * beside * normals).astype(np.float32), directions.astype(np.float32), 1)
        return np.where(hits.shape[0] >= 0, hits.t[0], np.float32(np.inf))

    ways_out = np.zeros(len(places), int)
    for angle in (np.arange(DIRECTIONS) + 0.5) * 2 * np.pi / DIRECTIONS:
        ways_out += np.isinf(distances(1, np.broadcast_to([np.cos(angle), np.sin(angle), 0.0], places.shape)))
    thickness = distances(-1, -normals)
    is_inner: Bool[np.ndarray, " place"] = (ways_out <= MOST_OPEN) & np.isfinite(thickness)
    if is_inner.mean() < LEAST_PART:
        return None
    is_side = is_inner & (np.abs(normals[:, 2]) < 0.5)
    median = float(np.median(thickness[is_side if is_side.any() else is_inner]))
    lengths = np.where(is_inner, np.minimum(thickness, THICKEST * median), 0)
    return Wall(thickness=median, shifts=(lengths[:, None] * normals)[of.ravel()].astype(np.float32))
