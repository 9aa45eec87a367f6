"""Vertex normals for shading: which ones disagree with their faces, and new ones."""

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.meshes import Mesh, face_corners, normals_of, welded

MAX_OPPOSING = 0.01
"""Share of face corners whose normal may point to the back of the face. The worst good asset that was measured has
0.0009, one with flipped normals 1; rendered glass with flipped normals is 25 dB off."""


def count_without_normal(mesh: Mesh) -> int:
    """Number of vertices of faces whose normal is 0 or not finite."""
    return int(is_without_normal(mesh)[np.unique(mesh.faces)].sum())


def opposing_share(mesh: Mesh) -> float:
    """The share of face corners whose normal points to the back of their face."""
    normals = mesh.normals.astype(np.float64)[mesh.faces]
    return float((np.einsum("fc,fkc->fk", normals_of(face_corners(mesh)), normals) < 0).mean())


def with_new_normals(mesh: Mesh, *, crease_deg: float) -> Mesh:
    """The mesh with smooth normals; vertices are split where faces meet at more than the crease angle. uv are kept."""
    positions, faces = welded(mesh)
    normals = corner_normals(positions.astype(np.float64), faces, crease_deg=crease_deg)
    at, first, index = split_corners(mesh.faces, normals)
    return Mesh(vertices=mesh.vertices[at], faces=index, normals=normals[first].astype(np.float32), uv=mesh.uv[at])


def split_corners(
    faces: np.ndarray, normals: Float[np.ndarray, "corner 3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The vertex and the corner of each new vertex, and new faces: corners that agree on vertex and normal are one."""
    at = faces.reshape(-1)
    keys = np.concatenate([at[:, None], np.rint(normals * 4096).astype(np.int64)], axis=-1)
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return at[first], first, index.reshape(-1, 3).astype(np.int32)


def corner_normals(
    positions: Float[np.ndarray, "p 3"], faces: np.ndarray, *, crease_deg: float
) -> Float[np.ndarray, "corner 3"]:
    """Unit normals of all corners, face by face; 0 where no face around a corner has an area.

    A corner's normal is the mean over the faces around its point that are within the crease angle of its own face,
    weighted by area and by the angle at the point; over all of them if its own face has no area.
    """
    corners = positions[faces]
    edges = np.roll(corners, -1, axis=1) - corners
    normals = np.cross(edges[:, 0], edges[:, 1])
    areas = np.linalg.norm(normals, axis=-1)
    normals, forth = unit(normals), unit(edges)
    angles = np.arccos(np.clip(-np.einsum("fki,fki->fk", forth, np.roll(forth, 1, axis=1)), -1, 1))
    weights = (angles * areas[:, None]).reshape(-1)

    # All pairs of corners at the same point.
    at = faces.reshape(-1)
    order = np.argsort(at, kind="stable")
    starts = np.searchsorted(at[order], at)
    counts = np.bincount(at, minlength=len(positions))[at]
    one = np.repeat(np.arange(len(at)), counts)
    other = order[np.repeat(starts, counts) + np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)]
    is_smooth = np.einsum("pi,pi->p", normals[one // 3], normals[other // 3]) >= np.cos(np.radians(crease_deg))
    is_smooth |= (areas[one // 3] == 0) | (one == other)  # At 0 degrees, rounding excludes a corner's own face.
    sums = np.zeros((len(at), 3))
    for axis in range(3):
        values = np.where(is_smooth, weights[other] * normals[other // 3, axis], 0.0)
        sums[:, axis] = np.bincount(one, values, minlength=len(at))
    return unit(sums)


def unit(vectors: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """The vectors scaled to length 1; zero vectors stay zero."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1)


def is_without_normal(mesh: Mesh) -> Bool[np.ndarray, " vertex"]:
    """Which vertices have a normal that is 0 or not finite."""
    lengths = np.linalg.norm(mesh.normals.astype(np.float64), axis=-1)
    return ~(np.isfinite(lengths) & (lengths > 1e-6))
