"""Glass of any shape from masks: its visual hull, carved on a grid, then smoothed as far as the masks allow; and the
views whose masks contradict the others, for instance because something opaque hides a part of the glass."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy import ndimage, sparse
from scipy.sparse import linalg
from scipy.spatial import KDTree

from datagen.data.meshes import Mesh, mesh_from, vertex_normals
from datagen.disk.errors import HyalineError
from datagen.scene.atlas import unwrap
from hyaline_photos.fit.outside import find_center
from hyaline_photos.fit.shapes import Glass
from hyaline_photos.fit.views import NearRays, Sightings, closest, outvoted, pull, rays_near, unexplained

COARSE, FINEST = 40, 200
"""Cells along the first grid, and most along the second one."""
FACES = 20_000
"""Approximate face count of a hull."""
ORDER = 0.02
"""Share of the views that may be wrong about a point: the hull is where no larger share sees past it."""
LEAST_VIEWS = 3
"""Views that have to look at a point; it is empty otherwise."""
OUT = 0.01
"""Distance in metres assumed for points outside every view's range."""
BLUR = 0.7
"""Blur of the distance to a mask's edge, in pixels; it smooths stair steps."""
SOFTNESS = (0.6, 0.4, 0.25, 0.15, 0.1, 0.1)
"""Pixels over which a ray turns from meeting the surface to missing it, in one step after the other."""
CONTACT_CELLS = 48
"""Cells along the grid on which rays look for the surface."""
NEAR = 4
"""Vertices that share in the surface's distance from a point."""
STEP = 0.003
"""Most metres that a vertex moves in one step."""
RELAXED = 10
"""Steps along the surface that make faces of marching cubes even."""
SMOOTH = (0.7, 1.0, 1.5, 2.2)
"""Pixels below which bumps are smoothed away: a drilled block's edges ask for the first, a knot for the third, with
which its normals are 1.5 instead of 2.3 degrees off."""
LEFT_OUT = 4
"""One of this many views is left out for that."""
PIXELS_OFF = 2.0
"""Tolerance of a mask's edge in pixels."""
TESTED_RAYS, TESTED_PLACES = 4000, 32
"""Rays through masks that views are compared by, and places along each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HullShape(Glass):
    """Solid glass of any shape."""

    surface: Mesh
    """Without texels before it is unwrapped."""

    @property
    def kind(self) -> str:
        return "hull"

    def unwrapped(self) -> "HullShape":
        """With texels of its own everywhere."""
        return HullShape(surface=unwrap(self.surface, where="a visual hull"))

    def mesh(self) -> Mesh:
        return self.surface


def carve(sightings: Sightings, object_id: int, up: Float[np.ndarray, "3"], support: float | None = None) -> HullShape:
    """Carves an object's visual hull, and smooths its stair steps as far as left out views ask for.

    Args:
        support: height along `up` of the known surface below it; the hull ends there.

    Raises:
        HyalineError: no point is inside all masks, or no ray passes beside them.
    """
    rays = rays_near(sightings, object_id)
    positions, faces = _carved(sightings, object_id, rays, up, support)

    def smoothed(some: NearRays, scale: float) -> Mesh:
        return mesh_from(_smoothed(positions, faces, some, scale, up=up, support=support), faces)

    return HullShape(surface=smoothed(rays, _scale_of_bumps(rays, smoothed)))


# Views


def overruled_views(sightings: Sightings, object_id: int, up: Float[np.ndarray, "3"]) -> Int[np.ndarray, " overruled"]:
    """Views whose masks lack parts of an object of any shape that the other views show (`outvoted`)."""
    rays = rays_near(sightings, object_id)
    center, radius = find_center(rays, up)
    rng, hits = np.random.default_rng(0), np.flatnonzero(rays.hits)
    rays = rays.only(np.sort(rng.permutation(hits)[:TESTED_RAYS]))
    middle = ((center - rays.origins) * rays.directions).sum(axis=1)
    points = rays.at(middle[:, None] + radius * np.linspace(-1, 1, TESTED_PLACES)).reshape(-1, 3)
    told = np.stack([depths(points).astype(np.float32) for depths in _depths(sightings, object_id)])
    told = told.reshape(len(told), -1, TESTED_PLACES) + PIXELS_OFF * rays.pixel_angle * float(np.median(middle))
    return np.flatnonzero(sightings.sees(object_id).any(axis=(1, 2)))[outvoted(told)]


# Carving


Depths = Callable[[Float64[np.ndarray, "point 3"]], Float64[np.ndarray, " point"]]
"""How far inside a mask's edge points are seen, in metres at their depth; infinite where the view shows nothing."""


def _carved(
    sightings: Sightings, object_id: int, rays: NearRays, up: np.ndarray, support: float | None
) -> tuple[Float64[np.ndarray, "vertex 3"], Int[np.ndarray, "face 3"]]:
    """The hull's surface."""
    import trimesh
    from skimage.measure import marching_cubes

    views = _depths(sightings, object_id)
    center, radius = find_center(rays, up)

    def depth_inside(points: Float64[np.ndarray, "point 3"]) -> Float64[np.ndarray, " point"]:
        depth = _depth_inside(views, points)
        return depth if support is None else np.minimum(depth, points @ up - support)

    low = center - radius
    coarse_step = 2 * radius / (COARSE - 1)
    grid = low + coarse_step * np.argwhere(np.ones((COARSE,) * 3))
    field = depth_inside(grid).reshape((COARSE,) * 3)
    if not (field > 0).any() or (field > 0).all():
        raise HyalineError(f"object {object_id}: its masks have no point in common, or no ray passes beside it")
    area = 1.5 * coarse_step**2 * sum(int((np.diff(field > 0, axis=axis)).sum()) for axis in range(3)) / 2
    step = np.sqrt(2 * area / FACES)
    count = int(np.clip(2 * radius / step + 1, COARSE, FINEST))
    step = 2 * radius / (count - 1)
    fine = np.asarray(ndimage.zoom(field, count / COARSE, order=1))
    near = np.abs(fine) < 1.8 * coarse_step
    points = low + np.argwhere(near) * step
    fine[near] = depth_inside(points)
    fine[[0, -1]] = fine[:, [0, -1]] = fine[:, :, [0, -1]] = -step
    vertices, faces, _, _ = marching_cubes(fine, 0.0)
    # Parts beside the largest one are places that no view sees past.
    surface = trimesh.Trimesh(low + vertices.astype(np.float64) * step, faces[:, ::-1], process=False)
    largest = max(surface.split(only_watertight=False), key=lambda part: len(part.faces))
    return np.asarray(largest.vertices, np.float64), np.asarray(largest.faces, np.int64)


def _depths(sightings: Sightings, object_id: int) -> list[Depths]:
    """One entry for each view that sees the object."""
    sees, is_open = sightings.sees(object_id), sightings.is_open(object_id)

    def depths_of(view: int) -> Depths:
        camera, past = sightings.cameras[view], is_open[view] & ~sees[view]
        inside = ndimage.gaussian_filter(_to_nearest(~past) - _to_nearest(past), BLUR).astype(np.float32)
        with np.errstate(divide="ignore"):
            nearness = 1 / sightings.depth[view]

        def depths(points: Float64[np.ndarray, "point 3"]) -> Float64[np.ndarray, " point"]:
            place, depth = camera.project(points)
            at = place.T[::-1] - 0.5
            away = np.linalg.norm(points - camera.world_from_camera[:3, 3], axis=1)
            edge, near = (
                ndimage.map_coordinates(values, at, order=1, mode="nearest", output=np.float64)
                for values in (inside, nearness)
            )
            in_picture = ((place > 0) & (place < [camera.width, camera.height])).all(axis=1)
            return np.where((depth > 0) & in_picture & (away * near < 1), edge * depth / camera.focal, np.inf)

        return depths

    return [depths_of(int(view)) for view in np.flatnonzero(sees.any(axis=(1, 2)))]


def _to_nearest(mask: Bool[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """Pixels from the middle of each pixel of the mask to the edge of the nearest one beside it; 0 beside it."""
    # Beyond the picture's border nothing is known.
    if mask.all():
        return np.full(mask.shape, float(max(mask.shape)))
    return np.maximum(np.asarray(ndimage.distance_transform_edt(mask)) - 0.5, 0)


def _depth_inside(views: list[Depths], points: Float64[np.ndarray, "point 3"]) -> Float64[np.ndarray, " point"]:
    """About how far inside of the hull points are, in metres; negative outside."""
    order = int(ORDER * len(views))
    depths = []
    for some in np.array_split(points, max(1, len(points) // 100_000)):
        told = np.stack([view(some) for view in views])
        is_seen = np.isfinite(told).sum(axis=0) >= LEAST_VIEWS
        depths.append(np.where(is_seen, np.partition(told, order, axis=0)[order], -OUT))
    return np.concatenate(depths)


# Smoothing


def _scale_of_bumps(rays: NearRays, smoothed: Callable[[NearRays, float], Mesh]) -> float:
    """The first of `SMOOTH` with which rays from most views predict the others better than with the next one."""
    is_left_out = np.unique(rays.view, return_inverse=True)[1] % LEFT_OUT == 0
    best, least = SMOOTH[0], np.inf
    for scale in SMOOTH:
        wrong = unexplained(smoothed(rays.only(~is_left_out), scale), rays.only(is_left_out))
        if not wrong <= least:  # Without rays at edges it is NaN.
            break
        best, least = scale, wrong
    return best


def _smoothed(
    positions: Float64[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    rays: NearRays,
    scale: float,
    *,
    up: Float[np.ndarray, "3"],
    support: float | None,
) -> Float64[np.ndarray, "vertex 3"]:
    """The smoothest surface near by that masks agree with.

    Each ray at a mask's edge says whether it passes inside or outside of the surface where it comes closest: a logistic
    regression on how far vertices move along their normals, with the surface's bending as a prior.

    Args:
        scale: pixels below which bumps are smoothed away.
    """
    import trimesh

    surface = trimesh.Trimesh(positions, faces, process=False)
    mean = sparse.csr_array(trimesh.smoothing.laplacian_calculation(surface, equal_weight=True))
    for _ in range(RELAXED):
        positions = _relaxed(positions, faces, mean)
    edge = rays.at_edges()
    for softness in SOFTNESS:
        contacts = _contacts(positions, faces, edge)
        positions = _relaxed(_moved(positions, faces, mean, contacts, softness, scale), faces, mean)
        if support is not None:
            positions = positions + np.maximum(support - positions @ up, 0)[:, None] * up
    return positions


def _relaxed(positions: np.ndarray, faces: np.ndarray, mean: sparse.csr_array) -> Float64[np.ndarray, "vertex 3"]:
    """Vertices moved along the surface towards the mean of their neighbours."""
    normals = vertex_normals(positions, faces)
    way = mean @ positions - positions
    return positions + 0.5 * (way - (way * normals).sum(axis=1, keepdims=True) * normals)


class _Contacts(NamedTuple):
    """Where rays come closest to a surface or are deepest inside it."""

    distance: Float64[np.ndarray, " ray"]
    """Signed, in metres; negative inside."""
    weights: sparse.csr_array
    """Shares of the vertices near by in it, (ray, vertex)."""
    pixel: Float64[np.ndarray, " ray"]
    """Width of a pixel there, in metres."""
    hits: Bool[np.ndarray, " ray"]


def _contacts(positions: Float64[np.ndarray, "vertex 3"], faces: np.ndarray, rays: NearRays) -> _Contacts:
    """The contacts of all rays that pass the surface nearby."""
    normals = vertex_normals(positions, faces)
    tree = KDTree(positions)
    low, high = positions.min(axis=0), positions.max(axis=0)
    margin = 0.1 * (high - low).max()
    step = float((high - low).max() + 2 * margin) / CONTACT_CELLS
    low -= margin
    counts = tuple(np.ceil((high + margin - low) / step).astype(int) + 1)
    points = low + step * np.argwhere(np.ones(counts))
    far, near = (np.asarray(found) for found in tree.query(points, distance_upper_bound=margin))
    known = np.isfinite(far)
    field = np.full(len(points), margin)
    field[known] = ((points[known] - positions[near[known]]) * normals[near[known]]).sum(axis=1)
    field = field.reshape(counts)
    middle, radius = (low + high + margin) / 2, float(np.linalg.norm(high + margin - low)) / 2
    between = ((middle - rays.origins) * rays.directions).sum(axis=1)
    first, last = np.clip(between - radius, 0, rays.reach), np.clip(between + radius, 0, rays.reach)

    def from_grid(t: Float64[np.ndarray, "ray place"]) -> Float64[np.ndarray, "ray place"]:
        at = np.moveaxis((rays.at(t) - low) / step, -1, 0)
        return np.asarray(ndimage.map_coordinates(field, at, order=1, mode="constant", cval=margin))

    nearest = closest(from_grid, first, last, (int(2 * radius / step),))
    # The same search on the surface itself, around the best place of the grid.
    kept = from_grid(nearest[:, None])[:, 0] < 0.99 * margin
    rays, nearest = rays.only(kept), nearest[kept]

    def from_surface(t: Float64[np.ndarray, "ray place"]) -> Float64[np.ndarray, "ray place"]:
        return _away(tree, positions, normals, rays.at(t).reshape(-1, 3))[0].reshape(t.shape)

    low_t, high_t = (np.clip(nearest + side * step, 0, rays.reach) for side in (-1, 1))
    nearest = closest(from_surface, low_t, high_t, (4, 4))
    distance, near, shares = _away(tree, positions, normals, rays.at(nearest))
    row = np.repeat(np.arange(len(near)), near.shape[1])
    weights = sparse.csr_array((shares.ravel(), (row, near.ravel())), shape=(len(near), len(positions)))
    return _Contacts(distance, weights, rays.pixel_angle * nearest, rays.hits)


def _away(
    tree: KDTree, positions: np.ndarray, normals: np.ndarray, points: Float64[np.ndarray, "point 3"]
) -> tuple[Float64[np.ndarray, " point"], Int[np.ndarray, "point near"], Float64[np.ndarray, "point near"]]:
    """Signed distance from a surface, the vertices near by, and their shares in it.

    Source: Kolluri 2008, implicit moving least squares.
    """
    far, near = (np.asarray(found) for found in tree.query(points, k=NEAR))
    shares = 1 / (far**2 + 1e-12)
    shares /= shares.sum(axis=1, keepdims=True)
    away = np.einsum("pkc,pkc->pk", points[:, None] - positions[near], normals[near])
    return (away * shares).sum(axis=1), near, shares


def _moved(
    positions: Float64[np.ndarray, "vertex 3"],
    faces: np.ndarray,
    mean: sparse.csr_array,
    contacts: _Contacts,
    softness: float,
    scale: float,
) -> Float64[np.ndarray, "vertex 3"]:
    """The surface after one Newton step along its normals."""
    normals = vertex_normals(positions, faces)
    slope, curvature = pull(contacts.distance, contacts.hits, softness * contacts.pixel)
    bending = mean - sparse.eye_array(len(positions))
    curved = ((mean @ positions - positions) * normals).sum(axis=1)
    # A bump of some width bends a surface as the width's fourth power; it counts against the rays that pass there.
    edges = np.linalg.norm(positions[faces] - positions[np.roll(faces, -1, axis=1)], axis=-1)
    pixel, spacing = float(np.median(contacts.pixel)), float(np.median(edges))
    stiff = 16 * scale**4 * pixel**2 / spacing**4 * len(contacts.hits) / len(positions)
    matrix = contacts.weights.T @ sparse.diags_array(curvature) @ contacts.weights + stiff * (bending.T @ bending)
    matrix = matrix + 1e-3 * stiff * sparse.eye_array(len(positions))
    force = contacts.weights.T @ slope - stiff * (bending.T @ curved)
    inverse = sparse.diags_array(1 / matrix.diagonal())
    step, _ = linalg.cg(matrix, force, rtol=1e-3, maxiter=300, M=inverse)
    return positions + np.clip(step, -STEP, STEP)[:, None] * normals
