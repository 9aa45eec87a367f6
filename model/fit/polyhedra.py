"""Convex polyhedra, such as cut stones, found from masks.

In a picture, the outline of a convex body is the convex hull of its corners. Each ray at a mask's edge tells on which
side of that polygon it passes: a logistic regression on the places of the corners. Corners without which the masks are
explained as well are removed, one after the other.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy import sparse
from scipy.spatial import ConvexHull

from datagen.data.meshes import Mesh
from datagen.scene.atlas import unwrap
from datagen.scene.modelling import convex_hull
from model.fit.lathe import perpendicular
from model.fit.shapes import Glass
from model.fit.silhouettes import descend, misfit, pull
from model.fit.views import NearRays

CONVEX = 0.9
"""Least share of its convex hull that a convex body fills, as masks show it."""

DIRECTIONS = 150
"""In each of so many directions, the farthest point of the hull is a first guess of a corner."""

SOFTNESS = (1.0, 0.5, 0.25, 0.12, 0.06)
"""Pixels over which a ray turns from meeting the body to missing it, in one round after the other."""

STEPS, FEW_STEPS = 20, 4
"""Largest number of Newton steps in a round, and after each corner that is removed."""

ENOUGH = 1e-4
"""Steps end when one gains less, relative to the misfit."""

PATIENCE = 12
"""So many corners are removed for nothing before the search ends."""

MOST_CORNERS = 60
"""More of them stand for a body with round sides."""

CREASE_DEG = 3.0
"""Facets that meet at less are shaded as one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Polyhedron(Glass):
    """A solid convex body with flat facets."""

    surface: Mesh
    num_corners: int

    @property
    def kind(self) -> str:
        return f"polyhedron with {self.num_corners} corners"

    def mesh(self) -> Mesh:
        return self.surface


@dataclass(frozen=True, kw_only=True, eq=False)
class _Picture:
    """The rays of one view, in a plane at distance 1 from its camera."""

    origin: Float64[np.ndarray, "3"]
    axes: Float64[np.ndarray, "3 3"]
    """Two in the plane, and the one that is perpendicular to it; one a row."""
    places: Float64[np.ndarray, "ray 2"]
    hits: Bool[np.ndarray, " ray"]
    reach: Float64[np.ndarray, " ray"]
    """Distance along the third axis of the first known surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Passes:
    """Where rays pass the outline, one view after the other."""

    distance: Float64[np.ndarray, " ray"]
    """Pixels from the outline; negative inside."""
    hits: Bool[np.ndarray, " ray"]
    corners: Int[np.ndarray, "ray 2"]
    """Between which the outline is nearest."""
    slopes: Float64[np.ndarray, "ray 2 3"]
    """Of the distance, by the places of these corners in metres."""


def fit_polyhedron(
    rays: NearRays, hull: Mesh, up: Float64[np.ndarray, "3"], support: float | None = None
) -> Polyhedron | None:
    """The convex polyhedron that explains the masks with the fewest corners; None if the body is none.

    Args:
        hull: the visual hull.
        support: height along `up` of the known surface below it, where it ends.
    """
    points = _first_corners(hull)
    if points is None:
        return None
    edge = rays.at_edges()
    pictures, pixel = _pictures(edge), rays.pixel_angle

    def fitted(corners: np.ndarray, softness: float, steps: int) -> tuple[Float64[np.ndarray, "kept 3"], float]:
        return _fitted(corners, pictures, pixel, softness, up, support, steps)

    loss = np.inf
    for softness in SOFTNESS:
        points, loss = fitted(points, softness, STEPS)
    # Schwarz 1978: each corner's three numbers have to gain this much likelihood.
    price = 1.5 * np.log(len(edge.hits)) / len(edge.hits)
    best, cost = points, loss + price * len(points)
    for_nothing = 0
    while len(points) > 4 and for_nothing < PATIENCE:
        points, loss = fitted(_without_flattest(points, 1 + len(points) // 30), SOFTNESS[-1], FEW_STEPS)
        for_nothing += 1
        if loss + price * len(points) < cost:
            best, cost, for_nothing = points, loss + price * len(points), 0
    best, _ = fitted(best, SOFTNESS[-1], STEPS)
    if len(best) > MOST_CORNERS:
        return None
    return Polyhedron(surface=_mesh_of(best), num_corners=len(best))


def _first_corners(hull: Mesh) -> Float64[np.ndarray, "corner 3"] | None:
    """Points of the hull that are farthest in some direction; None if it is not convex."""
    import trimesh

    solid = trimesh.Trimesh(hull.vertices, hull.faces, process=False)
    if solid.volume < CONVEX * solid.convex_hull.volume:
        return None
    place = np.arange(DIRECTIONS) + 0.5
    # Directions spread evenly over the sphere by the golden angle.
    height, angle = 1 - 2 * place / DIRECTIONS, np.pi * (3 - np.sqrt(5)) * place
    ring = np.sqrt(1 - height**2)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), height])
    points = hull.vertices.astype(np.float64)
    return points[np.unique((points @ directions).argmax(axis=0))]


def _pictures(rays: NearRays) -> list[_Picture]:
    pictures = []
    for view in np.unique(rays.view):
        some = rays.only(rays.view == view)
        middle = some.directions.mean(axis=0)
        middle /= np.linalg.norm(middle)
        axes = np.stack([*perpendicular(middle), middle])
        along = some.directions @ axes.T
        pictures.append(
            _Picture(
                origin=some.origins[0],
                axes=axes,
                places=along[:, :2] / along[:, 2:],
                hits=some.hits,
                reach=some.reach * along[:, 2],
            )
        )
    return pictures


def _fitted(
    corners: Float64[np.ndarray, "corner 3"],
    pictures: Sequence[_Picture],
    pixel: float,
    softness: float,
    up: Float64[np.ndarray, "3"],
    support: float | None,
    steps: int,
) -> tuple[Float64[np.ndarray, "kept 3"], float]:
    """The corners after damped Newton steps, without those that are inside, and the masks' misfit."""

    def judge(corners: np.ndarray) -> tuple[float, _Passes]:
        passes = _all_passes(corners, pictures, pixel)
        return misfit(passes.distance, passes.hits, softness), passes

    def step(corners: np.ndarray, passes: _Passes, damping: float) -> np.ndarray:
        gradient, curvature = _slopes(passes, len(corners), softness)
        diagonal = curvature.diagonal()
        # A corner that no outline shows stays where it is.
        way = np.linalg.solve(curvature + np.diag(damping * diagonal + 1e-3 * diagonal.mean() + 1e-12), gradient)
        tried = corners - way.reshape(-1, 3)
        return tried if support is None else tried + np.maximum(support - tried @ up, 0)[:, None] * up

    corners, loss = descend(corners, judge, step, damping=1e-2, steps=steps, enough=ENOUGH)
    return corners[_outermost(corners)], loss


def _all_passes(corners: np.ndarray, pictures: Sequence[_Picture], pixel: float) -> _Passes:
    parts = [_passes(corners, picture, pixel) for picture in pictures]
    names = [field.name for field in dataclasses.fields(_Passes)]
    return _Passes(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _passes(corners: Float64[np.ndarray, "corner 3"], picture: _Picture, pixel: float) -> _Passes:
    """How the rays of one view pass the outline."""
    at = (corners - picture.origin) @ picture.axes.T
    places = at[:, :2] / at[:, 2:]
    outline = ConvexHull(places).vertices  # Counter-clockwise.
    after = np.roll(outline, -1)
    a, way = places[outline], places[after] - places[outline]
    length = np.linalg.norm(way, axis=1)
    normal = np.stack([way[:, 1], -way[:, 0]], axis=1) / length[:, None]
    relative = picture.places[:, None] - a
    off = np.einsum("rec,ec->re", relative, normal)
    share = np.clip(np.einsum("rec,ec->re", relative, way) / length**2, 0, 1)
    away = relative - share[..., None] * way
    far = np.linalg.norm(away, axis=2)
    row, is_inside = np.arange(len(off)), (off <= 0).all(axis=1)
    side = np.where(is_inside, off.argmax(axis=1), far.argmin(axis=1))
    share, far = share[row, side], far[row, side]
    direction = np.where(is_inside[:, None], normal[side], away[row, side] / np.maximum(far, 1e-12)[:, None])
    ends = np.stack([outline[side], after[side]], axis=1)
    shares = np.stack([1 - share, share], axis=1)
    depth = at[ends, 2]
    # By a corner's place along the axes: its picture moves by 1 / depth across, and towards the middle in depth.
    across = -shares[..., None] * direction[:, None] / depth[..., None]
    inward = -(across * places[ends]).sum(axis=2, keepdims=True)
    slopes = np.concatenate([across, inward], axis=2) @ picture.axes
    is_known = picture.hits | (picture.reach > 1 / (shares / depth).sum(axis=1))
    return _Passes(
        distance=(np.where(is_inside, off[row, side], far) / pixel)[is_known],
        hits=picture.hits[is_known],
        corners=ends[is_known],
        slopes=slopes[is_known] / pixel,
    )


def _slopes(
    passes: _Passes, count: int, softness: float
) -> tuple[Float64[np.ndarray, " number"], Float64[np.ndarray, "number number"]]:
    """Gradient of the misfit and an approximate Hessian, by the places of the corners."""
    pulls, rays = pull(passes.distance, passes.hits, softness), len(passes.distance)
    columns = (3 * passes.corners[..., None] + np.arange(3)).reshape(rays, 6)
    row = np.repeat(np.arange(rays), 6)
    slopes = sparse.csr_array((passes.slopes.ravel(), (row, columns.ravel())), shape=(rays, 3 * count))
    weighted = slopes.T @ sparse.diags_array(pulls.curvature)
    return slopes.T @ pulls.slope / rays, (weighted @ slopes).toarray() / rays


def _outermost(points: Float64[np.ndarray, "point 3"]) -> Int[np.ndarray, " corner"]:
    return np.sort(ConvexHull(points).vertices)


def _without_flattest(corners: Float64[np.ndarray, "corner 3"], count: int) -> Float64[np.ndarray, "kept 3"]:
    """The corners without those that stand out least of the hull of all others."""
    heights = []
    for place, corner in enumerate(corners):
        planes = ConvexHull(np.delete(corners, place, axis=0)).equations
        heights.append((planes[:, :3] @ corner + planes[:, 3]).max())
    return np.delete(corners, np.argsort(heights)[:count], axis=0)


def _mesh_of(corners: Float64[np.ndarray, "corner 3"]) -> Mesh:
    return unwrap(convex_hull(corners, crease_deg=CREASE_DEG), where="a polyhedron")
