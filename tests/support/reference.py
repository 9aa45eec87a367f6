"""The slow oracles: loops and closed formulas that fast code is compared with."""

import itertools
from dataclasses import dataclass

import numpy as np

from datagen.data.meshes import Mesh, face_corners


@dataclass(frozen=True, kw_only=True)
class ReferenceHits:
    """All hits of one ray, nearest first, by brute force in float64."""

    shape: list[int]
    prim: list[int]
    t: list[float]
    barycentric: list[tuple[float, float]]
    is_general: bool
    """No hit is near an edge and no two hits are close together: every engine must agree."""


def brute_force_hits(meshes: tuple[Mesh, ...], origins: np.ndarray, directions: np.ndarray) -> list[ReferenceHits]:
    """Moeller and Trumbore against every triangle of every mesh whose bounding sphere the ray meets."""
    found: list[list[tuple[float, int, int, float, float, float]]] = [[] for _ in origins]
    for shape, mesh in enumerate(meshes):
        corners = mesh.vertices[mesh.faces].astype(np.float64)
        center = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)).astype(np.float64)
        radius = np.linalg.norm(mesh.vertices - center, axis=1).max() * 1.001
        to_center = center - origins
        along = np.einsum("ri,ri->r", to_center, directions)
        near = np.linalg.norm(to_center - along[:, None] * directions, axis=1) <= radius
        rays = np.flatnonzero(near & (along > -radius))
        step = max(1, 4_000_000 // len(corners))
        for start in range(0, len(rays), step):
            chunk = rays[start : start + step]
            for ray, prim, t, u, v in _triangle_hits(corners, origins[chunk], directions[chunk]):
                # Distance to the nearest edge in barycentric measure; the test also sees near misses.
                margin = min(u, v, 1 - u - v)
                found[chunk[ray]].append((t, shape, prim, u, v, margin))
    return [_sorted_hits(entries) for entries in found]


def _triangle_hits(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> list[tuple]:
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(directions[:, None], e2[None])
    det = np.einsum("rfi,fi->rf", p, e1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origins[:, None] - a[None]
        u = np.einsum("rfi,rfi->rf", s, p) / det
        # Most faces fail here; the rest of the work is done for the others alone.
        ray, face = np.nonzero((u >= -1e-4) & (u <= 1 + 1e-4) & (det != 0))
        q = np.cross(s[ray, face], e1[face])
        v = np.einsum("hi,hi->h", directions[ray], q) / det[ray, face]
        t = np.einsum("hi,hi->h", e2[face], q) / det[ray, face]
    u = u[ray, face]
    good = (v >= -1e-4) & (u + v <= 1 + 1e-4) & (t > 0)
    return list(zip(ray[good], face[good], t[good], u[good], v[good]))


def _sorted_hits(entries: list[tuple[float, int, int, float, float, float]]) -> ReferenceHits:
    entries = sorted(entries)
    is_general = all(entry[5] > 1e-4 for entry in entries)
    is_general &= all(after[0] - before[0] > 1e-5 for before, after in itertools.pairwise(entries))
    inside = [entry for entry in entries if entry[5] >= 0]
    return ReferenceHits(
        shape=[entry[1] for entry in inside],
        prim=[entry[2] for entry in inside],
        t=[entry[0] for entry in inside],
        barycentric=[(entry[3], entry[4]) for entry in inside],
        is_general=is_general,
    )


def fresnel_reflectance(cos_i: float, ior: float) -> float:
    """Unpolarised Fresnel reflectance from air into glass."""
    cos_t = np.sqrt(1 - (1 - cos_i**2) / ior**2)
    parallel = (ior * cos_i - cos_t) / (ior * cos_i + cos_t)
    perpendicular = (cos_i - ior * cos_t) / (cos_i + ior * cos_t)
    return float((parallel**2 + perpendicular**2) / 2)


def slow_convolution(
    image: np.ndarray, weight: np.ndarray, bias: np.ndarray, *, stride: int, padding: int
) -> np.ndarray:
    """A convolution (c_in, h, w) -> (c_out, h', w') with weights (c_out, c_in, k, k), one output pixel at a time."""
    size = weight.shape[-1]
    padded = np.pad(image, ((0, 0), (padding, padding), (padding, padding)))
    rows, columns = ((extent - size) // stride + 1 for extent in padded.shape[1:])
    out = np.zeros((len(weight), rows, columns))
    for row, column in np.ndindex(rows, columns):
        window = padded[:, row * stride : row * stride + size, column * stride : column * stride + size]
        out[:, row, column] = (weight * window).sum(axis=(1, 2, 3)) + bias
    return out


def slow_transposed_convolution(
    image: np.ndarray, weight: np.ndarray, bias: np.ndarray, *, stride: int, padding: int
) -> np.ndarray:
    """Its transpose, with weights (c_in, c_out, k, k): each input pixel adds a weighted kernel to the output."""
    size = weight.shape[-1]
    rows, columns = image.shape[1:]
    full = np.zeros((weight.shape[1], (rows - 1) * stride + size, (columns - 1) * stride + size))
    for row, column in np.ndindex(rows, columns):
        kernel = (image[:, row, column, None, None, None] * weight).sum(axis=0)
        full[:, row * stride : row * stride + size, column * stride : column * stride + size] += kernel
    inside = full[:, padding : full.shape[1] - padding, padding : full.shape[2] - padding]
    return inside + bias[:, None, None]


def interpolate(table: np.ndarray, place: np.ndarray) -> np.ndarray:
    """One point of a table (size, size, ..., c), linear along each axis between its cells, whose centres are whole."""
    result = np.zeros(table.shape[-1])
    base = np.floor(place).astype(int)
    for corner in itertools.product((0, 1), repeat=len(place)):
        weight = np.prod([part if bit else 1 - part for bit, part in zip(corner, place - base)])
        if weight > 0:
            result += weight * table[tuple(base + corner)]
    return result


def winding_numbers(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """How often a surface winds around each point: 1 inside, 0 outside. Source: van Oosterom and Strackee 1983."""
    a, b, c = np.moveaxis(face_corners(mesh).astype(np.float64)[None] - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    determinant = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
    dots = [np.einsum("pfi,pfi->pf", x, y) for x, y in ((a, b), (b, c), (c, a))]
    denominator = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return np.arctan2(determinant, denominator).sum(axis=1) / (2 * np.pi)
