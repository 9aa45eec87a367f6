"""Whether a closed mesh of any shape encloses another mesh: vertices, edges and faces, without sampling.

Where no edge of either surface crosses a face of the other, each connected part of the one lies all inside or all
outside the other, and one point tells which.
"""

import numpy as np
from jaxtyping import Float64, Int64

from datagen.data.meshes import Mesh, component_of_faces, face_corners, welded, winding_number

PAIRS_AT_ONCE = 1 << 20

FLAT = 1e-9
"""Sine of the angle with a face below which an edge that touches its plane counts as lying in it."""


def enclosed_share(proxy: Mesh, truth: Mesh) -> float:
    """Share of the object's faces that lie inside the proxy whole; 1 only when the proxy encloses all of it."""
    corners = face_corners(truth).astype(np.float64)
    is_inside = ~crossed_faces(proxy, truth)
    component = component_of_faces(truth)
    around = face_corners(proxy).astype(np.float64)
    for part in np.unique(component):
        mine = np.flatnonzero((component == part) & is_inside)
        if len(mine) and winding_number(corners[mine[0], 0], around) < 0.5:
            is_inside[mine] = False
    return float(is_inside.mean())


def crossed_faces(proxy: Mesh, truth: Mesh) -> np.ndarray:
    """Which of the object's faces (face,) meet the proxy's surface; those that touch it count."""
    crossed = np.zeros(len(truth.faces), bool)
    edges, faces_of = _edges(truth)
    for edge, _ in _crossings(edges, face_corners(proxy).astype(np.float64)):
        crossed[faces_of[edge].reshape(-1)] = True
    for _, face in _crossings(_edges(proxy)[0], face_corners(truth).astype(np.float64)):
        crossed[face] = True
    return crossed


def _edges(mesh: Mesh) -> tuple[Float64[np.ndarray, "edge 2 3"], Int64[np.ndarray, "edge 2"]]:
    """Ends of each edge of the welded surface, and two of its faces (the same twice, where it has but one)."""
    positions, faces = welded(mesh)
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    face = np.tile(np.arange(len(faces)), 3)
    edges, first, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    faces_of = np.stack([face[first], face[first]], axis=-1)
    faces_of[inverse.reshape(-1), 1] = face
    return positions.astype(np.float64)[edges], faces_of


def _crossings(edges: np.ndarray, corners: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs (edge, face) in pieces, of which the edge passes through the face or touches it."""
    found = []
    for edge, face in _near_pairs(edges, corners):
        (p, q), (a, b, c) = np.moveaxis(edges[edge], 1, 0), np.moveaxis(corners[face], 1, 0)
        normal = np.cross(b - a, c - a)
        # Of an edge in the face's plane nothing can be told, and nothing needs to be: others meet where it does.
        from_p, from_q = (np.einsum("pi,pi->p", normal, end - a) for end in (p, q))
        even = FLAT * np.linalg.norm(normal, axis=-1) * np.linalg.norm(q - p, axis=-1)
        meets = (from_p * from_q <= 0) & (np.maximum(np.abs(from_p), np.abs(from_q)) > even)
        edge, face, p, q, a, b, c = (array[meets] for array in (edge, face, p, q, a, b, c))
        # The line passes the triangle's three sides on one side of each.
        signs = [np.einsum("pi,pi->p", q - p, np.cross(one - p, other - p)) for one, other in ((a, b), (b, c), (c, a))]
        within = (np.min(signs, axis=0) >= 0) | (np.max(signs, axis=0) <= 0)
        found.append((edge[within], face[within]))
    return found


def _near_pairs(edges: np.ndarray, corners: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs (edge, face) in pieces, whose boxes along the axes meet."""
    low, high = edges.min(axis=1), edges.max(axis=1)
    face_low, face_high = corners.min(axis=1), corners.max(axis=1)
    # Sorted along the axis in which the faces are spread most, each edge meets a run of faces; wide faces make the runs
    # long, so faces of like width go together.
    axis = int(np.ptp(corners.reshape(-1, 3), axis=0).argmax())
    widths = face_high[:, axis] - face_low[:, axis]
    sizes = np.floor(np.log2(np.maximum(widths, 1e-3 * widths.max() + 1e-30))).astype(int)
    pieces = []
    for size in np.unique(sizes):
        order = np.flatnonzero(sizes == size)
        order = order[np.argsort(face_low[order, axis], kind="stable")]
        starts = np.searchsorted(face_low[order, axis], low[:, axis] - widths[order].max(), side="left")
        stops = np.searchsorted(face_low[order, axis], high[:, axis], side="right")
        counts = np.maximum(stops - starts, 0)
        ends = np.cumsum(counts)
        first = 0
        while first < len(edges):
            last = max(first + 1, int(np.searchsorted(ends, ends[first] - counts[first] + PAIRS_AT_ONCE, side="right")))
            part = slice(first, last)
            edge = np.repeat(np.arange(first, last), counts[part])
            run = np.arange(len(edge)) - np.repeat(np.cumsum(counts[part]) - counts[part], counts[part])
            face = order[np.repeat(starts[part], counts[part]) + run]
            meet = ((low[edge] <= face_high[face]) & (face_low[face] <= high[edge])).all(axis=1)
            pieces.append((edge[meet], face[meet]))
            first = last
    return pieces
