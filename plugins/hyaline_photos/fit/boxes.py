"""Boxes and panes with rounded edges, found from masks.

A box is convex, so that its signed distance has one minimum along a ray, which is negative where the ray meets the box.
Each ray at a mask's edge tells on which side of 0 that minimum lies: a logistic regression on the box's numbers.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
from jaxtyping import Float, Float64
from scipy import optimize

from datagen.data.meshes import Mesh, mesh_from
from datagen.scene.modelling import grid_faces, rotation
from hyaline_photos.fit.outside import find_center
from hyaline_photos.fit.shapes import Glass, perpendicular
from hyaline_photos.fit.views import NearRays, misfits, pull

SEGMENTS = 4
"""Steps of a rounded edge, per 45 degrees."""
LEAST_SIZE, LEAST_ROUNDING = 0.0005, 0.0001
"""Least half thickness of a box and least radius of its edges, in metres."""
MOST_ROUNDING = 0.5
"""Largest radius of the edges, in parts of the least half size."""
SOFTNESS = (3.0, 1.0, 0.3, 0.1, 0.03)
"""Pixels over which a ray turns from meeting the box to missing it, in one round of the search after the other."""
FINER = (0.03, 0.01, 0.003)
"""The same for all rays, kept where it explains more of them: with the last of `SOFTNESS`, 18 mm came out as 18.6."""
COARSE_RAYS, RAYS = 2500, 20_000
"""Rays that the first two rounds look at, and the most for the others, but for `FINER`."""
STEPS = 30
"""Largest number of steps in a round."""
ENOUGH = 3e-4
"""A round ends when a step gains less, relative to the misfit."""
BISECTIONS = 20
"""Interval halvings along a ray; they narrow it to a micrometre."""
TINY = 1e-8
"""Step in metres or radians of numerical derivatives."""
FLAT, THICK = 0.06, 0.02
"""Thickness of the panes that are tried in place of a box, over its width, and the share of edge pixels that a box may
get wrong before they are. While edges are soft, rays through a thin pane hardly meet it, so the box grows."""
USELESS = 0.3
"""Share of edge pixels beyond which a box is none; half of them are wrong for no shape at all."""
MOST_REACH = 1.5
"""Largest half diagonal in parts of how far the mask's rays pass from their middle: what others hide has no bounds."""
GUTTER = 0.01
"""Width of the empty border around each chart of the atlas."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Box(Glass):
    """A solid box with rounded edges."""

    center: Float64[np.ndarray, "3"]
    axes: Float64[np.ndarray, "3 3"]
    """Unit vectors in the world, one a row, right-handed; the last is the upward one."""
    half_sizes: Float64[np.ndarray, "3"]
    """Along its axes, in metres."""
    rounding: float
    """Radius of the edges in metres."""
    unexplained: float = 1.0
    """Share of the rays at the mask's edge that meet the box and should miss it, or the other way round."""

    @property
    def kind(self) -> str:
        return "box"

    def mesh(self) -> Mesh:
        return _rounded(self)


def fit_box(rays: NearRays, up: Float[np.ndarray, "3"], support: float | None = None) -> Box | None:
    """The upright box that explains the masks best.

    None if no box resembles the masks, or other objects hide too much of it.

    Args:
        support: height along `up` of the known surface below it; an upright box ends there.
    """
    rng = np.random.default_rng(0)
    # Where a mask shows the object, a known surface in front of it is misplaced, as parts of a fitted room are.
    rays = dataclasses.replace(rays, reach=np.where(rays.hits, np.inf, rays.reach))
    edge = rays.at_edges().thinned(RAYS)
    few = rays.only(np.sort(rng.permutation(len(rays.hits))[:COARSE_RAYS]))
    center, radius = find_center(rays, up)
    axes = np.stack([*perpendicular(up), up])
    start = Box(center=center, axes=axes, half_sizes=np.full(3, radius / 2), rounding=0.1 * radius)

    def sharpen(box: Box, steps: Sequence[float]) -> Box:
        for softness in steps:
            box = _fitted(box, edge, softness, support)
        return _judged(box, edge)

    wrong = attrgetter("unexplained")
    turns = [rotation(tuple(up), angle) for angle in range(0, 90, 15)]
    turned = [dataclasses.replace(start, axes=start.axes @ turn.T) for turn in turns]
    rough = [_fitted(_fitted(box, few, SOFTNESS[0], support), few, SOFTNESS[1], support) for box in turned]
    best = sharpen(min((_judged(box, few) for box in rough), key=wrong), SOFTNESS[1:])
    if best.unexplained > THICK:
        half = min(FLAT * min(best.half_sizes[:2]), best.half_sizes[2])
        flat, aside = np.array([*best.half_sizes[:2], half]), (best.half_sizes[2] - half) * axes[2]
        thin = dataclasses.replace(best, half_sizes=flat, rounding=min(best.rounding, half / 2))
        panes = [dataclasses.replace(thin, center=best.center + side * aside) for side in (1, -1)]
        best = min([best, *(sharpen(pane, SOFTNESS[2:]) for pane in panes)], key=wrong)
    every = rays.at_edges()
    best = _judged(best, every)
    for softness in FINER:
        best = min(best, _judged(_fitted(best, every, softness, support), every), key=wrong)
    is_seen = np.linalg.norm(best.half_sizes) < MOST_REACH * radius
    return best if is_seen and best.unexplained < USELESS else None


def _distance(box: Box, points: Float64[np.ndarray, "point 3"]) -> Float64[np.ndarray, " point"]:
    """Signed distance of points in metres; negative inside."""
    return _beyond(box, box.axes @ (points - box.center).T)


def _beyond(box: Box, points: Float64[np.ndarray, "3 point"]) -> Float64[np.ndarray, " point"]:
    """The same of points along the box's axes, from its centre."""
    q = np.abs(points) - (box.half_sizes - box.rounding)[:, None]
    x, y, z = np.maximum(q, 0)
    inside = np.minimum(np.maximum(np.maximum(q[0], q[1]), q[2]), 0)
    return np.sqrt(x * x + y * y + z * z) + inside - box.rounding


def _closest(box: Box, rays: NearRays) -> Float64[np.ndarray, "ray 3"]:
    """Where rays come closest to a box or are deepest inside it, up to the first known surface: the distance is convex
    along a ray, so that its slope says on which side the least is."""
    o, d = box.axes @ (rays.origins - box.center).T, box.axes @ rays.directions.T
    middle, radius = -(o * d).sum(axis=0), float(np.linalg.norm(box.half_sizes))
    high = np.clip(middle + radius, 0, rays.reach)
    low = np.clip(middle - radius, 0, high)
    for _ in range(BISECTIONS):
        t = (low + high) / 2
        here = o + t * d
        rises = _beyond(box, here + TINY * d) > _beyond(box, here)
        low, high = np.where(rises, low, t), np.where(rises, t, high)
    return rays.at(high)


def _fitted(box: Box, rays: NearRays, softness: float, support: float | None) -> Box:
    """The box whose silhouettes are most likely, from one nearby.

    Args:
        softness: in pixels.
    """
    width = softness * rays.pixel_angle * float(np.median(np.linalg.norm(rays.origins - box.center, axis=1)))
    # Place across, height of the bottom, half sizes, rounding in parts of the least of these, and turn.
    start = [*(box.axes @ box.center - [0, 0, box.half_sizes[2]]), *box.half_sizes]
    start = np.array([*start, box.rounding / box.half_sizes.min(), 0.0])
    bottom = -np.inf if support is None else support
    low = np.array([-np.inf, -np.inf, bottom, *[LEAST_SIZE] * 3, 0, -np.inf])
    high = np.array([*[np.inf] * 6, MOST_ROUNDING, np.inf])

    def shaped(numbers: Float64[np.ndarray, "8"]) -> Box:
        half_sizes = numbers[3:6]
        return dataclasses.replace(
            box,
            axes=box.axes @ rotation(tuple(box.axes[2]), np.degrees(numbers[7])).T,
            center=(numbers[:3] + np.array([0, 0, half_sizes[2]])) @ box.axes,
            half_sizes=half_sizes,
            rounding=float(max(numbers[6] * half_sizes.min(), min(LEAST_ROUNDING, MOST_ROUNDING * half_sizes.min()))),
        )

    def residuals(numbers: Float64[np.ndarray, "8"]) -> Float64[np.ndarray, " ray"]:
        tried = shaped(numbers)
        return np.sqrt(misfits(_distance(tried, _closest(tried, rays)), rays.hits, width))

    def slopes(numbers: Float64[np.ndarray, "8"]) -> Float64[np.ndarray, "ray 8"]:
        # Where a ray comes closest, its distance does not change with the place along it.
        points = _closest(shaped(numbers), rays)
        before = _distance(shaped(numbers), points)
        moved = np.stack([_distance(shaped(numbers + move), points) for move in TINY * np.eye(8)], axis=1)
        by_distance = pull(before, rays.hits, width)[0] / (2 * np.sqrt(misfits(before, rays.hits, width)))
        return by_distance[:, None] * (moved - before[:, None]) / TINY

    found = optimize.least_squares(
        residuals,
        np.clip(start, low, high),
        jac=slopes,  # pyright: ignore[reportArgumentType]
        bounds=(low, high),
        method="dogbox",
        ftol=ENOUGH,
        x_scale="jac",
        max_nfev=STEPS,
    )
    return shaped(found.x)


def _judged(box: Box, rays: NearRays) -> Box:
    """The box and how much it leaves unexplained of these rays."""
    meets = _distance(box, _closest(box, rays)) < 0
    return dataclasses.replace(box, unexplained=float((meets != rays.hits).mean()))


def _rounded(box: Box) -> Mesh:
    """A grid on each side of a box, moved onto its rounded edges; faces that meet share their corners bit by bit."""
    steps = np.tan(np.linspace(0, np.pi / 4, SEGMENTS + 1))
    steps[-1] = 1.0
    core = box.half_sizes - box.rounding
    lines = [np.concatenate([-(inner + box.rounding * steps[::-1]), inner + box.rounding * steps]) for inner in core]
    count = len(steps) * 2
    quads = grid_faces(count, count)
    points, faces, uv = [], [], []
    for side in range(6):
        axis, sign = side // 2, (-1, 1)[side % 2]
        u, v = (axis + 1) % 3, (axis + 2) % 3
        grid = np.empty((count, count, 3))
        grid[..., axis] = sign * (core[axis] + box.rounding)
        grid[..., u], grid[..., v] = lines[u][:, None], lines[v][None, :]
        points.append(grid.reshape(-1, 3))
        faces.append((quads if sign > 0 else quads[:, ::-1]) + side * count * count)
        ways = [(line - line[0]) / np.ptp(line) for line in (lines[u], lines[v])]
        place = np.stack(np.broadcast_arrays(ways[0][:, None], ways[1][None, :]), axis=-1).reshape(-1, 2)
        corner, size = np.array([axis / 3, (side % 2) / 2]), np.array([1 / 3, 1 / 2])
        uv.append(corner + GUTTER + place * (size - 2 * GUTTER))
    on_cube = np.concatenate(points)
    inner = np.clip(on_cube, -core, core)
    normals = on_cube - inner
    normals /= np.sqrt((normals * normals).sum(axis=1, keepdims=True))
    # Sums instead of a matrix product, which may round equal rows differently.
    position = sum(((inner + box.rounding * normals)[:, [axis]] * box.axes[axis] for axis in range(3)), box.center)
    return mesh_from(position, np.concatenate(faces), normals @ box.axes, np.concatenate(uv))
