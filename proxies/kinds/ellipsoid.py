"""Proxies of kind `ellipsoid`: the ellipsoid of least volume, as a polyhedron that encloses the whole object."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from datagen.data.meshes import Mesh, mesh_from
from datagen.scene.modelling import grid_faces
from proxies.solid import Solid, gauge, planes_of

TOLERANCE = 1e-5
"""Tolerance of the optimality conditions; measured volumes are then within 3e-5 of the least."""

MAX_STEPS = 20_000

CELLS = 16
"""Grid cells along an edge of the octahedron: 8 * 16^2 = 2048 faces, 0.35 % more volume than a smooth ellipsoid.

It must be a multiple of 4 for the tessellation of the sphere to be convex (a test checks that).
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ellipsoid:
    """The set center + root y with |y| <= 1."""

    center: Float64[np.ndarray, "3"]
    root: Float64[np.ndarray, "3 3"]
    """Symmetric and positive definite; its eigenvalues are the radii in metres. A symmetric root keeps the texture
    aligned with the world: eigenvectors would be arbitrary where two radii are equal."""
    weights: Float64[np.ndarray, "point"]
    """Non-negative, summing to 1: the dual solution, positive only at points on the surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SphereGrid:
    """The unit sphere in an equal-area octahedral map; vertices at the map's border are doubled."""

    positions: Float64[np.ndarray, "position 3"]
    """Unique positions."""
    position_of: Int64[np.ndarray, "vertex"]
    uv: Float64[np.ndarray, "vertex 2"]
    faces: Int64[np.ndarray, "face 3"]
    """Outward, on the vertices."""


def fit_ellipsoid(solid: Solid, *, padding: float) -> Mesh:
    """The solid's smallest ellipsoid as a polyhedron around all points, its radii longer by `padding` metres."""
    ellipsoid = smallest_ellipsoid(solid.hull_points)
    grid = sphere_grid(CELLS)
    # Flat facets cut into the ellipsoid, so it grows until the polyhedron reaches the outermost point.
    root = ellipsoid.root * _gauge(grid, ellipsoid.root, solid.points - ellipsoid.center)
    root = root + padding * np.eye(3)
    # Growing each radius by a different factor tilts facets, so enclosure is checked again.
    root = root * max(1.0, _gauge(grid, root, solid.points - ellipsoid.center))
    x, y, z = (grid.positions[:, axis, None] for axis in range(3))
    # Element by element, not by matrix product: BLAS rounds equal rows differently, and seams would open.
    positions = ellipsoid.center + x * root[0] + y * root[1] + z * root[2]
    normals = grid.positions @ np.linalg.inv(root)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return mesh_from(positions[grid.position_of], grid.faces, normals[grid.position_of], grid.uv)


def smallest_ellipsoid(points: Float64[np.ndarray, "point 3"]) -> Ellipsoid:
    """The ellipsoid of least volume around points that are not flat.

    Source: Khachiyan 1996 with the away steps of Todd and Yildirim 2007, which make it converge linearly; the start is
    Kumar and Yildirim's few extreme points.
    """
    # The result is affine invariant; whitened points keep the arithmetic well conditioned.
    mean = points.mean(axis=0)
    spread = np.linalg.cholesky(np.cov((points - mean).T, bias=True))
    whitened = np.linalg.solve(spread, (points - mean).T).T
    weights = _dual_weights(whitened)
    center = weights @ whitened
    scatter = (whitened - center).T @ (weights[:, None] * (whitened - center))
    values, vectors = np.linalg.eigh(3 * spread @ scatter @ spread.T)
    return Ellipsoid(
        center=mean + spread @ center,
        root=(vectors * np.sqrt(values)) @ vectors.T,
        weights=weights,
    )


def sphere_grid(cells: int) -> SphereGrid:
    """The tessellated unit sphere: a square grid of uv, folded over the octahedron.

    Source: Clarberg 2008, Fast equal-area mapping of the (hemi)sphere using SIMD.
    """
    # Integer lattice of the octahedron, so that folded vertices coincide exactly.
    i, j = (grid.reshape(-1) - cells for grid in np.meshgrid(*[np.arange(2 * cells + 1)] * 2, indexing="ij"))
    height = cells - np.abs(i) - np.abs(j)
    x = np.where(height >= 0, i, np.where(i < 0, -1, 1) * (cells - np.abs(j)))
    y = np.where(height >= 0, j, np.where(j < 0, -1, 1) * (cells - np.abs(i)))
    lattice, position_of = np.unique(np.stack([x, y, height], axis=-1), axis=0, return_inverse=True)
    lower, upper = np.split(grid_faces(2 * cells + 1, 2 * cells + 1), 2)
    (a, b, c), d = lower.T, upper[:, 2]
    # The diagonal runs along the octahedron's edges, or the folded cells would be concave.
    is_falling = ((i[a] + i[c]) < 0) == ((j[a] + j[c]) < 0)
    first = np.where(is_falling[:, None], np.stack([a, b, d], axis=-1), np.stack([a, b, c], axis=-1))
    second = np.where(is_falling[:, None], np.stack([b, c, d], axis=-1), np.stack([a, c, d], axis=-1))
    return SphereGrid(
        positions=_to_sphere(lattice / cells),
        position_of=position_of.reshape(-1).astype(np.int64),
        uv=np.stack([i, j], axis=-1) / (2 * cells) + 0.5,
        faces=np.concatenate([first, second]).astype(np.int64),
    )


def _to_sphere(octahedron: np.ndarray) -> np.ndarray:
    """Points (n, 3) of |x| + |y| + |z| = 1 onto the unit sphere, areas in the map's square kept in proportion."""
    x, y, z = octahedron.T
    radius = np.abs(x) + np.abs(y)
    angle = 0.25 * np.pi * np.where(radius > 0, (np.abs(y) - np.abs(x)) / np.where(radius > 0, radius, 1) + 1, 0)
    ring = radius * np.sqrt(2 - radius**2)
    return np.stack(
        [np.sign(x) * ring * np.cos(angle), np.sign(y) * ring * np.sin(angle), np.sign(z) * (1 - radius**2)], axis=-1
    )


def _gauge(grid: SphereGrid, root: np.ndarray, points: np.ndarray) -> float:
    """The factor by which the tessellated ellipsoid around the origin must grow to enclose the points."""
    local = np.linalg.solve(root, points.T).T
    planes = planes_of(grid.positions[grid.position_of][grid.faces])
    # No facet is nearer than the innermost, so points near to the centre cannot be the outermost.
    radii = np.linalg.norm(local, axis=-1)
    return gauge(planes, local[radii * np.linalg.norm(planes, axis=-1).max() >= radii.max()])


def _dual_weights(points: np.ndarray) -> np.ndarray:
    """Weights (n,) that maximise log det of the weighted scatter of the points lifted by a 1."""
    lifted = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    weights = np.zeros(len(points))
    start = _extreme_points(points)
    weights[start] = 1 / len(start)
    size = lifted.shape[1]
    for _ in range(MAX_STEPS):
        inverse = np.linalg.inv(lifted.T @ (weights[:, None] * lifted))
        heights = np.einsum("ni,ij,nj->n", lifted, inverse, lifted)
        farthest = int(heights.argmax())
        nearest = int(np.where(weights > 0, heights, np.inf).argmin())
        excess, lack = heights[farthest] / size - 1, 1 - heights[nearest] / size
        if max(excess, lack) <= TOLERANCE:
            break
        if excess >= lack:
            # Give weight to the farthest point: the exact line search.
            step = (heights[farthest] - size) / (size * (heights[farthest] - 1))
            weights *= 1 - step
            weights[farthest] += step
        else:
            # Take weight from a point inside, at most all that it has.
            most = weights[nearest] / (1 - weights[nearest])
            height = heights[nearest]
            step = min(most, (size - height) / (size * (height - 1))) if height > 1 else most
            weights *= 1 + step
            weights[nearest] = 0 if step == most else weights[nearest] - step
    return weights / weights.sum()


def _extreme_points(points: np.ndarray) -> np.ndarray:
    """Indices of up to six points that span the space: the farthest pair along three directions in turn."""
    chosen: list[int] = []
    spanned = np.zeros((0, 3))
    for _ in range(3):
        # A direction across all that is spanned so far.
        direction = np.linalg.svd(np.concatenate([spanned, np.zeros((1, 3))]), full_matrices=True)[2][-1]
        along = points @ direction
        low, high = int(along.argmin()), int(along.argmax())
        chosen += [low, high]
        spanned = np.concatenate([spanned, (points[high] - points[low])[None]])
    return np.unique(chosen)
