"""How far a mesh is from the true one: distances, normals, and the thickness of walls."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from datagen.data.meshes import Mesh, SurfacePoints, crossings, face_corners, nearest_points, normals_of, points_on

SAMPLES = 4096
"""Points on each mesh where distances and normals are compared."""
WALL_SAMPLES = 2048
"""Points on each mesh where thickness is measured."""


@dataclass(frozen=True, kw_only=True)
class ShapeErrors:
    """How far a mesh is from the true one; lengths in metres."""

    chamfer: float
    """Chamfer distance: the mean distance from each surface to the other, averaged over both directions."""
    normal_deg: float
    """Median angle in degrees between shading normals, on points of the mesh and the nearest true ones."""
    thickness: float | None
    """Median thickness of the mesh, measured from its outside; None if it is open."""
    true_thickness: float | None
    """Median thickness of the true mesh."""


def shape_errors(mesh: Mesh, truth: Mesh) -> ShapeErrors:
    """Compares two surfaces on points of both, the same ones every time."""
    found, back = points_on(mesh, SAMPLES), points_on(truth, SAMPLES)
    forth, near = nearest_points(found.position, face_corners(truth).astype(np.float64))
    back, _ = nearest_points(back.position, face_corners(mesh).astype(np.float64))
    cosines = np.einsum("pc,pc->p", shading_normals(mesh, found), shading_normals(truth, near))
    return ShapeErrors(
        chamfer=float(forth.mean() + back.mean()) / 2,
        normal_deg=float(np.degrees(np.arccos(np.clip(np.median(cosines), -1, 1)))),
        thickness=_median(measure_walls(mesh)),
        true_thickness=_median(measure_walls(truth)),
    )


def shading_normals(mesh: Mesh, points: SurfacePoints) -> Float64[np.ndarray, "point 3"]:
    """Unit normals as light sees them, interpolated between the corners of each point's face."""
    from trimesh.triangles import points_to_barycentric

    weights = points_to_barycentric(face_corners(mesh)[points.face].astype(np.float64), points.position)
    normals = np.einsum("pk,pkc->pc", weights, mesh.normals[mesh.faces[points.face]].astype(np.float64))
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def measure_walls(mesh: Mesh, count: int = WALL_SAMPLES) -> Float64[np.ndarray, " point"]:
    """Distances in metres along the face's normal, inwards, to the next surface, from points of the outside.

    The outside is where the normal meets the mesh nowhere else; points with no surface opposite are left out.
    """
    corners, found = face_corners(mesh), points_on(mesh, count)
    directions = normals_of(corners)[found.face]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    tolerance = 1e-6 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    thickness = np.full(count, np.inf)
    for line, _, along in crossings(corners, found.position, directions):
        np.minimum.at(thickness, line, np.where(along < -tolerance, -along, np.inf))
        thickness[line[along > tolerance]] = -np.inf  # Not outside; the minimum keeps it so.
    return thickness[np.isfinite(thickness)]


def _median(values: Float[np.ndarray, " _"]) -> float | None:
    return float(np.median(values)) if len(values) else None
