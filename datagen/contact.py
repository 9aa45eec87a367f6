"""Owns the search for faces that lie in faces of another mesh: where two surfaces coincide, layers get lost."""

import numpy as np
from jaxtyping import Bool, Float

from datagen.meshes import Mesh, face_corners

TOLERANCE = 1e-4
"""Metres from plane to plane that count as none: a path tracer's rays start about so far from their surface."""

EDGE = 1e-7
"""Metres by which two faces of one plane must overlap: those that share an edge do not."""

_PAIRS_AT_ONCE = 1 << 22


def count_touching_faces(mesh: Mesh, other: Mesh) -> int:
    """How many faces of a mesh overlap a face of the other that lies in the same plane, whichever way they look.

    Planes that are up to `TOLERANCE` apart are the same, if the smaller face lies in it with all three corners.
    """
    a, b = (face_corners(item).astype(np.float64) for item in (mesh, other))
    if not (len(a) and len(b)):
        return 0
    a, b = a[_meets(a, b.reshape(-1, 3))], b[_meets(b, a.reshape(-1, 3))]
    touching = np.zeros(len(a), bool)
    step = max(1, _PAIRS_AT_ONCE // max(1, len(b)))
    low, high = b.min(axis=1) - TOLERANCE, b.max(axis=1) + TOLERANCE
    for start in range(0, len(a), step):
        part = a[start : start + step]
        meets = (part.min(axis=1)[:, None] <= high).all(axis=-1) & (part.max(axis=1)[:, None] >= low).all(axis=-1)
        first, second = np.nonzero(meets)
        same = _in_one_plane(part[first], b[second])
        first, second = first[same], second[same]
        touching[start + first[_overlap(part[first], b[second])]] = True
    return int(touching.sum())


def _meets(corners: Float[np.ndarray, "face 3 3"], points: Float[np.ndarray, "point 3"]) -> Bool[np.ndarray, " face"]:
    """Faces whose bounding box meets that of the points."""
    low, high = points.min(axis=0) - TOLERANCE, points.max(axis=0) + TOLERANCE
    return ((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=-1)


def _unit_normals(corners: Float[np.ndarray, "pair 3 3"]) -> Float[np.ndarray, "pair 3"]:
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _in_one_plane(a: Float[np.ndarray, "pair 3 3"], b: Float[np.ndarray, "pair 3 3"]) -> Bool[np.ndarray, " pair"]:
    n_a, n_b = _unit_normals(a), _unit_normals(b)
    a_from_b = np.abs(np.einsum("pkc,pc->pk", a - b[:, :1], n_b)).max(axis=1)
    b_from_a = np.abs(np.einsum("pkc,pc->pk", b - a[:, :1], n_a)).max(axis=1)
    # A face smaller than the tolerance lies in any plane that it meets.
    is_parallel = np.abs(np.einsum("pc,pc->p", n_a, n_b)) > 0.9
    return is_parallel & (np.minimum(a_from_b, b_from_a) <= TOLERANCE)


def _overlap(a: Float[np.ndarray, "pair 3 3"], b: Float[np.ndarray, "pair 3 3"]) -> Bool[np.ndarray, " pair"]:
    """Pairs of triangles in about one plane that no line in this plane parts (the separating axis theorem)."""
    normals = _unit_normals(b)
    overlap = np.ones(len(a), bool)
    for corners in (a, b):
        for start in range(3):
            axis = np.cross(normals, corners[:, (start + 1) % 3] - corners[:, start])
            axis /= np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-30)
            on_a, on_b = (np.einsum("pkc,pc->pk", item, axis) for item in (a, b))
            first_end = np.minimum(on_a.max(axis=1), on_b.max(axis=1))
            overlap &= first_end > np.maximum(on_a.min(axis=1), on_b.min(axis=1)) + EDGE
    return overlap
