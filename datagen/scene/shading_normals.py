"""Vertex normals for shading: which ones disagree with their faces, and how to compute them."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.meshes import Mesh, vertex_normals, welded

MAX_OPPOSING = 0.01
"""Share of face corners whose normal may point to the back of the face. The worst good asset that was measured has
0.0009, one with flipped normals 1; rendered glass with flipped normals is 25 dB off."""


def count_without_normal(mesh: Mesh) -> int:
    """Number of vertices of faces whose normal is 0 or not finite."""
    return int(_is_without(mesh)[np.unique(mesh.faces)].sum())


def opposing_share(mesh: Mesh) -> float:
    """The share of face corners whose normal points to the back of their face."""
    normals = mesh.normals.astype(np.float64)[mesh.faces]
    return float((np.einsum("fc,fkc->fk", _face_normals(mesh), normals) < 0).mean())


def mended_normals(mesh: Mesh, *, crease_deg: float) -> tuple[Mesh, str | None]:
    """The mesh with usable shading normals, and a remark on what was done; the same mesh if all is well.

    Args:
        crease_deg: faces that meet at a sharper angle get a hard edge if all normals are computed again.
    """
    bad = _is_without(mesh)
    bad_share = float(bad[mesh.faces].mean())
    known = dataclasses.replace(mesh, normals=np.where(bad[:, None], 0, mesh.normals).astype(np.float32))
    if (opposing := opposing_share(known)) > MAX_OPPOSING:
        remark = f"{100 * opposing:.1f} % of its vertex normals pointed to the back of their faces"
        return with_new_normals(mesh, crease_deg=crease_deg), f"{remark}; normals were computed again"
    if bad_share > MAX_OPPOSING:
        remark = f"{100 * bad_share:.1f} % of its vertex normals were 0 or not finite"
        return with_new_normals(mesh, crease_deg=crease_deg), f"{remark}; normals were computed again"
    if bad_share > 0:
        normals = np.where(bad[:, None], vertex_normals(mesh.vertices, mesh.faces), mesh.normals)
        few = dataclasses.replace(mesh, normals=normals.astype(np.float32))
        count = count_without_normal(mesh)
        return few, f"{count} of its vertex normals were 0 or not finite; these were computed again"
    return mesh, None


def with_new_normals(mesh: Mesh, *, crease_deg: float) -> Mesh:
    """The mesh with smooth normals; vertices are split where faces meet at more than the crease angle. uv are kept."""
    positions, faces = welded(mesh)
    normals = corner_normals(positions.astype(np.float64), faces, crease_deg=crease_deg)
    at = mesh.faces.reshape(-1)
    # Corners that agree on vertex and normal stay one vertex.
    keys = np.concatenate([at[:, None], np.rint(normals * 4096).astype(np.int64)], axis=-1)
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return Mesh(
        vertices=mesh.vertices[at[first]],
        faces=index.reshape(-1, 3).astype(np.int32),
        normals=normals[first].astype(np.float32),
        uv=mesh.uv[at[first]],
    )


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
    normals, forth = _unit(normals), _unit(edges)
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
    return _unit(sums)


def _unit(vectors: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """The vectors scaled to length 1; zero vectors stay zero."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1)


def _is_without(mesh: Mesh) -> Bool[np.ndarray, " vertex"]:
    lengths = np.linalg.norm(mesh.normals.astype(np.float64), axis=-1)
    return ~(np.isfinite(lengths) & (lengths > 1e-6))


def _face_normals(mesh: Mesh) -> Float[np.ndarray, "face 3"]:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(np.float64), 1, 0)
    return np.cross(b - a, c - a)
