"""Planes through points of the room: which way is up, walls, and the floor as far as pictures see it.

Points are in metres with z up, but for `find_up`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.data.meshes import Mesh
from datagen.scene.modelling import sheet
from hyaline_photos.capture.rectangles import Flat, Rectangle, smallest_rectangle

Points = Float[np.ndarray, "_ 3"]

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


def find_up(points: Points, cameras: Float[np.ndarray, "view 4 4"]) -> Float[np.ndarray, "3"]:
    """Across the plane with the most points that the cameras look down on; their own up without such a plane."""
    mean = cameras[:, :3, 1].mean(axis=0)
    mean /= max(np.linalg.norm(mean), 1e-9)
    if len(points) < LEAST_POINTS:
        return mean
    middle = np.median(points, axis=0)
    near = NEAR * float(np.median(np.linalg.norm(cameras[:, :3, 3] - middle, axis=1)))
    rng, best, most = np.random.default_rng(0), mean, 0
    for three in _samples(rng, points, 3):
        normal = np.cross(three[1] - three[0], three[2] - three[0])
        normal /= max(np.linalg.norm(normal), 1e-12)
        normal *= np.sign(normal @ mean) or 1.0
        above = ((cameras[:, :3, 3] - three[0]) @ normal > 0).mean()
        # Cameras that look down by 45 degrees from one side have an up that is 45 degrees off.
        if normal @ mean < np.cos(np.radians(50)) or above < 0.95:
            continue
        count = int((np.abs((points - three[0]) @ normal) < near).sum())
        if count > most:
            best, most = _plane_through(points, three[0], normal, near), count
    return best if most >= LEAST_SHARE * len(points) else mean


def _plane_through(points: Points, place: np.ndarray, normal: np.ndarray, near: float) -> Float[np.ndarray, "3"]:
    """The normal of the plane that fits the points near a plane."""
    for _ in range(3):
        on = points[np.abs((points - place) @ normal) < near]
        place = on.mean(axis=0)
        found = np.linalg.svd(on - place, full_matrices=False)[2][2]
        normal = found * (np.sign(found @ normal) or 1.0)
    return normal


def _samples(rng: np.random.Generator, points: np.ndarray, count: int) -> Iterator[np.ndarray]:
    for _ in range(RANSAC_TRIES):
        yield points[rng.choice(len(points), count, replace=False)]


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
    points: Points, places: Float[np.ndarray, "view 3"], middle: np.ndarray, radius: float, few: float
) -> tuple[list[Wall], Points]:
    """Walls with all cameras and the glass in front of them, the one with the most points first; other points."""
    rng, near, walls, rest = np.random.default_rng(1), FARTHER * NEAR * radius, [], points
    inner = np.concatenate([places[:, :2], middle[None, :2]])
    while len(walls) < MAX_WALLS and len(points) >= few:
        best, most = None, 0
        for two in _samples(rng, points[:, :2], 2):
            line = two[1] - two[0]
            if (length := np.linalg.norm(line)) < 0.1 * radius:
                continue
            normal = np.array([-line[1], line[0]]) / length
            normal *= np.sign((middle[:2] - two[0]) @ normal) or 1.0
            if ((inner - two[0]) @ normal).min() < 2 * near:
                continue
            ahead = (points[:, :2] - two[0]) @ normal
            on = np.abs(ahead) < near
            if on.sum() > most and (ahead < -near).mean() < MAX_BEHIND:
                best, most = (two[0], normal), int(on.sum())
        if best is None or most < few:
            break
        place, normal = best
        normal = _line_through(points[:, :2], place, normal, near)
        offset = float(np.median((points[:, :2] @ normal)[np.abs((points[:, :2] - place) @ best[1]) < near]))
        is_on = np.abs(points[:, :2] @ normal - offset) < near
        on, points = points[is_on], points[~is_on]
        along = on[:, :2] @ [-normal[1], normal[0]]
        low, high = np.percentile(along, (1, 99))
        bottom, top = np.percentile(on[:, 2], (2, 99))
        is_large = high - low >= LEAST_WALL[0] * radius and top - bottom >= LEAST_WALL[1] * radius
        if is_large and np.mean(np.histogram(along, BINS, (low, high))[0] > 1) > 0.6:
            walls.append(Wall(normal=normal, offset=offset, reach=(float(low), float(high)), top=float(top)))
            points, rest = (some[walls[-1].ahead(some[:, :2]) > near] for some in (points, rest))
    return walls, rest


def _line_through(flat: Flat, place: np.ndarray, normal: np.ndarray, near: float) -> Float[np.ndarray, "2"]:
    on = flat[np.abs((flat - place) @ normal) < near]
    found = np.linalg.svd(on - on.mean(axis=0), full_matrices=False)[2][1]
    return found * (np.sign(found @ normal) or 1.0)


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
    mesh = sheet((*start, floor), (*((ends[1] - ends[0]) * wall.along), 0), (0, 0, top - floor))
    return _facing(mesh, np.array([*wall.normal, 0.0]))


def _facing(mesh: Mesh, normal: np.ndarray) -> Mesh:
    if mesh.normals[0] @ normal > 0:
        return mesh
    return Mesh(vertices=mesh.vertices, faces=mesh.faces[:, ::-1].copy(), normals=-mesh.normals, uv=mesh.uv)


def floor_within(points: Points, walls: Sequence[Wall], middle: np.ndarray) -> Rectangle:
    """The floor: along the first wall, as far as points show it and a little farther, and not beyond walls."""
    angle = float(np.arctan2(walls[0].along[1], walls[0].along[0])) if walls else None
    # The middle of the scene belongs to it, whatever points show.
    base = smallest_rectangle(np.concatenate([points[:, :2], middle[None, :2]]), 0.5, angle)
    axes, ends = base.axes, []
    for axis, place, half in zip(axes, np.array(base.center) @ axes.T, base.half, strict=True):
        low, high = place - (1 + MARGIN) * half, place + (1 + MARGIN) * half
        for wall in walls:
            slope = float(wall.normal @ axis)
            if abs(slope) > 0.95:
                if slope > 0:
                    low = wall.offset / slope
                else:
                    high = wall.offset / slope
        ends.append((low, high))
    low, high = np.array(ends).T
    return Rectangle(center=tuple((low + high) / 2 @ axes), half=tuple((high - low) / 2), angle=base.angle)


def floor_around(ground: Rectangle, walls: Sequence[Wall], middle: np.ndarray, reach: float) -> list[Rectangle]:
    """Up to four rectangles around the floor, out to some distance from the middle but not beyond walls.

    Each becomes a part of its own, so that its large area takes no texels from the floor.
    """
    axes = ground.axes
    low, high = (np.array(ground.center) @ axes.T + sign * np.array(ground.half) for sign in (-1, 1))
    outer = np.array([np.minimum(low, middle[:2] @ axes.T - reach), np.maximum(high, middle[:2] @ axes.T + reach)])
    for axis, place in ((axis, place) for axis in range(2) for place in range(2)):
        if any((1 - 2 * place) * (wall.normal @ axes[axis]) > 0.95 for wall in walls):
            outer[place, axis] = (low, high)[place][axis]
    corners = (
        (outer[0], (low[0], outer[1, 1])),
        ((high[0], outer[0, 1]), outer[1]),
        ((low[0], outer[0, 1]), (high[0], low[1])),
        ((low[0], high[1]), (high[0], outer[1, 1])),
    )
    return [
        Rectangle(center=tuple((start + end) / 2 @ axes), half=tuple((end - start) / 2), angle=ground.angle)
        for start, end in (np.array(pair) for pair in corners)
        if (end - start).min() > 0
    ]
