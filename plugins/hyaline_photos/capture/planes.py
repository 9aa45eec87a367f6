"""Planes through points of the room: which way is up, walls, the floor that is seen; rectangles, and boxes on them.

Points are in metres with z up, but for `find_up`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.meshes import Mesh, mesh_from
from datagen.scene.modelling import moved, rotation, rounded_box, sheet, transformed

Points = Float[np.ndarray, "_ 3"]
Flat = Float[np.ndarray, "_ 2"]
NEAR = 0.012
"""Distance from a surface that counts as on it, over the cameras' distance; so are the next lengths."""
FARTHER = 2.5
"""Tolerance for walls: they are far away, so points on them are less accurate."""
LEAST_WALL = (0.5, 0.2)
"""Length and height of the smallest wall."""
FAR = 4.0
"""How far the floor goes on where no wall ends it: a ray that goes down meets something."""
LEAST_POINTS = 25
"""Points that make a plane or a thing."""
LEAST_SHARE = 0.01
"""Share of all points on a floor or a wall."""
MAX_BEHIND = 0.05
"""Share of the points that may lie behind a wall or below the floor: they were seen in a mirror, or matched wrongly."""
BINS = 10
"""Parts of a wall; points lie on most of them, as they do not on a line through two things."""
MAX_WALLS = 4
MARGIN = 0.15
"""Margin added around the points of a floor or wall, relative to their extent."""
RANSAC_TRIES = 3000


@dataclass(frozen=True, kw_only=True)
class Rectangle:
    """A rectangle in the plane, at an angle to the axes."""

    center: tuple[float, float]
    half: tuple[float, float]
    angle: float
    """Radians from +x towards +y."""

    @property
    def axes(self) -> Float[np.ndarray, "2 2"]:
        """Unit vectors along its sides, as rows."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.array([[c, s], [-s, c]])

    def holds(self, flat: Flat, *, margin: float = 0.0) -> Bool[np.ndarray, "_"]:
        """True for points in it."""
        return np.all(np.abs((flat - self.center) @ self.axes.T) <= np.array(self.half) + margin, axis=1)

    def sheet(self, height: float) -> Mesh:
        """It, facing up."""
        along, across = self.axes * np.array(self.half)[:, None]
        corner = np.array(self.center) - along - across
        return sheet((*corner, height), (*(2 * along), 0), (*(2 * across), 0))


def smallest_rectangle(flat: Flat, percent: float = 2.0, angle: float | None = None) -> Rectangle:
    """The smallest rectangle around all points but few."""

    def at(turn: float) -> Rectangle:
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        low, high = np.percentile(flat @ axes.T, (percent, 100 - percent), axis=0)
        return Rectangle(center=tuple((low + high) / 2 @ axes), half=tuple((high - low) / 2), angle=float(turn))

    return min(map(at, np.radians(np.arange(0, 90, 2)) if angle is None else [angle]), key=lambda it: np.prod(it.half))


def box_on(base: Rectangle, low: float, high: float) -> Mesh:
    """A box over a rectangle."""
    size = (2 * base.half[0], 2 * base.half[1], high - low)
    box = rounded_box(size, bevel=0.02 * min(size), segments=1)
    turned = transformed(box, rotation((0, 0, 1), float(np.degrees(base.angle))), (0, 0, 0))
    return moved(turned, (*base.center, (low + high) / 2))


def down_to(level: float, thing: Mesh, reach: float, within: Rectangle | None = None) -> Mesh:
    """A surface with upright walls from its open edges near a level one down to that, where it was cut off."""
    edges = thing.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    edges = edges[first[count == 1]]
    is_near = np.abs(thing.vertices[:, 2] - level - reach / 2) < reach / 2
    is_near &= True if within is None else within.holds(thing.vertices[:, :2])
    edges = edges[is_near[edges].all(axis=1)]
    rim, (start, end) = np.unique(edges), edges.T
    below, flat = thing.vertices[rim].copy(), thing.normals[rim] * (1, 1, 0)
    below[:, 2] = level
    start_below, end_below = (len(thing.vertices) + np.searchsorted(rim, place) for place in (start, end))
    faces = np.array([[end, start, start_below], [end, start_below, end_below]]).transpose(0, 2, 1).reshape(-1, 3)
    return mesh_from(
        np.concatenate([thing.vertices, below]),
        np.concatenate([thing.faces, faces]),
        np.concatenate([thing.normals, flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6)]),
    )


# Which way is up


def find_up(points: Points, cameras: Float[np.ndarray, "view 4 4"]) -> Float[np.ndarray, "3"]:
    """Across the plane with the most points that the cameras look down on; their own up without such a plane."""
    mean = cameras[:, :3, 1].mean(axis=0)
    mean /= max(np.linalg.norm(mean), 1e-9)
    if len(points) < LEAST_POINTS:
        return mean
    middle, places = np.median(points, axis=0), cameras[:, :3, 3]
    near = NEAR * float(np.median(np.linalg.norm(places - middle, axis=1)))
    best, most = mean, LEAST_SHARE * len(points)
    for place, normal in _tried(np.random.default_rng(0), points, mean):
        # Cameras that look down by 45 degrees from one side have an up that is 45 degrees off.
        if normal @ mean < np.cos(np.radians(50)) or ((places - place) @ normal > 0).mean() < 0.95:
            continue
        count = int((np.abs((points - place) @ normal) < near).sum())
        if count > most:
            best, most = _through(points, place, normal, near)[1], count
    return best


def _tried(
    rng: np.random.Generator, points: Float[np.ndarray, "point dim"], towards: Float[np.ndarray, " dim"]
) -> Iterator[tuple[Float[np.ndarray, " dim"], Float[np.ndarray, " dim"]]]:
    """Planes, or lines in a plane, through a few of some points: a point on each, and its normal.

    Args:
        towards: a direction in which normals point.
    """
    count = points.shape[1]
    some = points[rng.integers(len(points), size=(RANSAC_TRIES, count))]
    normals = np.linalg.svd(some[:, 1:] - some[:, :1])[2][:, -1]
    yield from zip(some[:, 0], normals * np.where(normals @ towards < 0, -1, 1)[:, None], strict=True)


def _through(
    points: Float[np.ndarray, "point dim"], place: np.ndarray, normal: np.ndarray, near: float
) -> tuple[Float[np.ndarray, " dim"], Float[np.ndarray, " dim"]]:
    """A point on the plane or line that fits the points near one, and its normal."""
    for _ in range(3):
        on = points[np.abs((points - place) @ normal) < near]
        place = on.mean(axis=0)
        found = np.linalg.svd(on - place, full_matrices=False)[2][-1]
        normal = found * (np.sign(found @ normal) or 1.0)
    return place, normal


# Walls and floor


@dataclass(frozen=True, kw_only=True, eq=False)
class Wall:
    """An upright plane, and how far the points on it reach."""

    normal: Float[np.ndarray, "2"]
    """Towards the cameras, seen from above."""
    offset: float
    reach: tuple[float, float]
    """Along the normal turned by a right angle to the left."""
    top: float

    @property
    def along(self) -> Float[np.ndarray, "2"]:
        """Unit vector along the wall."""
        return np.array([-self.normal[1], self.normal[0]])

    def ahead(self, flat: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Distance in front of the wall."""
        return flat @ self.normal - self.offset


def find_walls(
    points: Points, ground: Flat, places: Float[np.ndarray, "view 3"], middle: np.ndarray, radius: float, few: float
) -> tuple[list[Wall], Points]:
    """Walls with cameras, glass and ground before them, the one with the most points first; other points."""
    rng, near, walls, rest = np.random.default_rng(1), FARTHER * NEAR * radius, [], points
    inner = np.concatenate([places[:, :2], middle[None, :2]])
    while len(walls) < MAX_WALLS and len(points) >= few:
        flat, best, most = points[:, :2], None, few - 1
        for place, normal in _tried(rng, flat, np.ones(2)):
            normal = normal * (np.sign((middle[:2] - place) @ normal) or 1.0)
            if ((inner - place) @ normal).min() < 2 * near:
                continue
            on = int((np.abs((flat - place) @ normal) < near).sum())
            if on > most and max(((each - place) @ normal < -near).mean() for each in (flat, ground)) < MAX_BEHIND:
                best, most = (place, normal), on
        if best is None:
            break
        place, normal = _through(flat, *best, near)
        is_on = np.abs((flat - place) @ normal) < near
        on, points = points[is_on], points[~is_on]
        along = on[:, :2] @ [-normal[1], normal[0]]
        low, high = np.percentile(along, (1, 99))
        bottom, top = np.percentile(on[:, 2], (2, 99))
        is_large = high - low >= LEAST_WALL[0] * radius and top - bottom >= LEAST_WALL[1] * radius
        if is_large and np.mean(np.histogram(along, BINS, (low, high))[0] > 1) > 0.6:
            wall = Wall(normal=normal, offset=float(place @ normal), reach=(float(low), float(high)), top=float(top))
            points, rest = (some[wall.ahead(some[:, :2]) > near] for some in (points, rest))
            walls.append(wall)
    return walls, rest


def wall_mesh(wall: Wall, walls: Sequence[Wall], floor: float) -> Mesh:
    """A wall, from the floor up, to where it meets others."""
    low, high = wall.reach
    grown = MARGIN * (high - low)
    ends = [low - grown, high + grown]
    for other in walls:
        slope = float(wall.along @ other.normal)
        if other is wall or abs(slope) < 0.3:
            continue
        # Where both walls meet; they end there if that is near.
        meets = (other.offset - wall.offset * float(wall.normal @ other.normal)) / slope
        side = int(meets > (low + high) / 2)
        if abs(meets - (low, high)[side]) < 0.5 * (high - low):
            ends[side] = meets
    top = wall.top + MARGIN * (wall.top - floor)
    start = wall.offset * wall.normal + ends[0] * wall.along
    # Upwards and along, in the order that makes it face the cameras.
    return sheet((*start, floor), (*((ends[1] - ends[0]) * wall.along), 0), (0, 0, top - floor))


def floor_within(points: Flat, walls: Sequence[Wall], middle: np.ndarray) -> Rectangle:
    """The floor: along the first wall, as far as points show it and a little farther, and not beyond walls."""
    angle = float(np.arctan2(walls[0].along[1], walls[0].along[0])) if walls else None
    # The middle of the scene belongs to it, whatever points show.
    base = smallest_rectangle(np.concatenate([points, middle[None, :2]]), 0.5, angle)
    place, half = np.array(base.center) @ base.axes.T, (1 + MARGIN) * np.array(base.half)
    ends = np.stack([place - half, place + half])
    for wall in walls:
        for axis, slope in enumerate(base.axes @ wall.normal):
            if abs(slope) > 0.95:
                ends[int(slope < 0), axis] = wall.offset / slope
    low, high = ends
    return Rectangle(center=tuple((low + high) / 2 @ base.axes), half=tuple((high - low) / 2), angle=base.angle)
