"""Boxes and panes with rounded edges, found from masks.

A box is convex, so that its signed distance has one minimum along a ray, which is negative where the ray meets the box.
Each ray at a mask's edge tells on which side of 0 that minimum lies: a logistic regression on the box's numbers.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from datagen.data.meshes import Mesh
from datagen.scene.modelling import grid_faces, rotation
from hyaline_photos.fit.lathe import perpendicular
from hyaline_photos.fit.outside import find_center
from hyaline_photos.fit.shapes import Glass
from hyaline_photos.fit.silhouettes import descend, errors, misfit, pull
from hyaline_photos.fit.views import NearRays

SEGMENTS = 4
"""Steps of a rounded edge, per 45 degrees."""

LEAST_SIZE, LEAST_ROUNDING = 0.0005, 0.0001
"""Least half thickness of a box and least radius of its edges, in metres."""

MOST_ROUNDING = 0.9
"""Largest radius of the edges, in parts of the least half size."""

SOFTNESS = (3.0, 1.0, 0.3, 0.1, 0.03)
"""Pixels over which a ray turns from meeting the box to missing it, in one round of the search after the other."""

FINER = (0.03, 0.01, 0.003)
"""The same for all rays, kept where it explains more of them: with the last of `SOFTNESS`, a pane of 18 mm came out as
18.6 mm."""

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
get wrong before they are. While edges are soft, rays through a thin pane hardly meet it, so the box grows behind one of
its faces, out of sight."""

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
    center, radius = find_center(rays)
    axes = np.stack([*perpendicular(up), up])
    start = Box(center=center, axes=axes, half_sizes=np.full(3, radius / 2), rounding=0.1 * radius)

    def sharpen(box: Box, steps: Sequence[float]) -> Box:
        for softness in steps:
            box = _fitted(box, edge, softness, support)
        return _judged(box, edge)

    turned = [_turned(start, angle) for angle in np.radians(range(0, 90, 15))]
    rough = [_fitted(_fitted(box, few, SOFTNESS[0], support), few, SOFTNESS[1], support) for box in turned]
    best = sharpen(min((_judged(box, few) for box in rough), key=_errors_of), SOFTNESS[1:])
    if best.unexplained > THICK:
        best = min([best, *(sharpen(pane, SOFTNESS[2:]) for pane in _panes(best))], key=_errors_of)
    best = _finer(best, rays.at_edges(), support)
    is_seen = np.linalg.norm(best.half_sizes) < MOST_REACH * radius
    return best if is_seen and best.unexplained < USELESS else None


def _finer(box: Box, rays: NearRays, support: float | None) -> Box:
    box = _judged(box, rays)
    for softness in FINER:
        box = min(box, _judged(_fitted(box, rays, softness, support), rays), key=_errors_of)
    return box


def _errors_of(box: Box) -> float:
    return box.unexplained


def _panes(box: Box) -> list[Box]:
    """Thin boxes at the upper and the lower face of one."""
    width, depth, height = box.half_sizes
    half = min(FLAT * min(width, depth), height)
    return [
        dataclasses.replace(
            box,
            center=box.center + side * (height - half) * box.axes[2],
            half_sizes=np.array([width, depth, half]),
            rounding=min(box.rounding, half / 2),
        )
        for side in (1, -1)
    ]


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
    """The box whose silhouettes are most likely, from one nearby: damped Newton steps.

    Args:
        softness: in pixels.
    """
    width = softness * rays.pixel_angle * float(np.median(np.linalg.norm(rays.origins - box.center, axis=1)))

    def judge(box: Box) -> tuple[float, np.ndarray]:
        points = _closest(box, rays)
        return misfit(_distance(box, points), rays.hits, width), points

    def step(box: Box, points: np.ndarray, damping: float) -> Box:
        before = _distance(box, points)
        # Where a ray comes closest, its distance does not change with the place along it.
        moves = TINY * np.eye(8)
        slopes = np.stack([(_distance(_moved(box, move), points) - before) / TINY for move in moves])
        pulls = pull(before, rays.hits, width)
        curvature = (slopes * pulls.curvature) @ slopes.T / len(before)
        damped = curvature + damping * np.diag(curvature.diagonal() + 1e-9)
        way = -np.linalg.solve(damped, slopes @ pulls.slope / len(before))
        return _limited(_moved(box, way), support)

    return descend(box, judge, step, damping=1e-3, steps=STEPS, enough=ENOUGH)[0]


def _moved(box: Box, step: Float64[np.ndarray, "8"]) -> Box:
    """The box after a step in center, half sizes, rounding and turn."""
    return dataclasses.replace(
        _turned(box, float(step[7])),
        center=box.center + step[:3],
        half_sizes=box.half_sizes + step[3:6],
        rounding=float(box.rounding + step[6]),
    )


def _limited(box: Box, support: float | None) -> Box:
    """The box within the limits of its numbers, above its support."""
    up, half_sizes, center = box.axes[2], np.maximum(box.half_sizes, LEAST_SIZE), box.center
    most = MOST_ROUNDING * half_sizes.min()
    rounding = float(np.clip(box.rounding, min(LEAST_ROUNDING, most), most))
    if support is not None and (below := support - (center @ up - half_sizes[2])) > 0:
        half_sizes = np.maximum(half_sizes - [0, 0, below / 2], LEAST_SIZE)
        center = center + below / 2 * up
    return dataclasses.replace(box, center=center, half_sizes=half_sizes, rounding=rounding)


def _turned(box: Box, angle: float) -> Box:
    """The box turned about its upward axis, by radians."""
    return dataclasses.replace(box, axes=box.axes @ rotation(tuple(box.axes[2]), np.degrees(angle)).T)


def _judged(box: Box, rays: NearRays) -> Box:
    """The box and how much it leaves unexplained of these rays."""
    return dataclasses.replace(
        box, unexplained=float((errors(_distance(box, _closest(box, rays)), rays.hits) > 0).mean())
    )


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
    return Mesh(
        vertices=position.astype(np.float32),
        faces=np.concatenate(faces).astype(np.int32),
        normals=(normals @ box.axes).astype(np.float32),
        uv=np.concatenate(uv).astype(np.float32),
    )
