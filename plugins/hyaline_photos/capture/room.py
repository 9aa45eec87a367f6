"""Fits an opaque room to points and depth maps: a floor, the support of the glass, and the surfaces of all else.

Points are in metres with z up, but for `find_up`. Of every surface only its front counts, which a texture is learned
for; what depth maps do not show (plain walls) is left to the sky.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.meshes import Mesh
from datagen.scene.modelling import sheet
from hyaline_photos.capture.fusing import fuse
from hyaline_photos.capture.outlines import GAP, Outline
from hyaline_photos.capture.stereo import DepthMaps

Points = Float[np.ndarray, "_ 3"]
Flat = Float[np.ndarray, "_ 2"]

NEAR = 0.012
"""Distance from a surface that counts as on it, over the cameras' distance; so are the next lengths."""
FAR = 4.0
"""How far the floor goes on: a ray that goes down meets something."""
CLOSE = 0.75
"""Half the box around the glass in which surfaces are as fine as depth maps; beyond, they are `COARSER` times so."""
COARSER = 4
CELL = 0.05
"""Distance up to which points are of one surface."""
LEAST_POINTS = 25
"""Points that make a plane."""
LEAST_SHARE = 0.01
"""Share of all points on a floor or a support."""
MAX_BELOW = 0.05
"""Share of the points that may lie below the floor: they were seen in a mirror, or matched wrongly."""
MARGIN = 0.15
"""Margin added around the points of a floor, relative to their extent."""
MAX_THINGS = 24
RANSAC_TRIES = 3000


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of the room."""

    name: str
    mesh: Mesh


@dataclass(frozen=True, kw_only=True)
class Room:
    """All parts, including the support of the glass."""

    parts: tuple[Part, ...]
    support: float | None
    """Height of the surface below the glass; None where no points show one."""
    remark: str


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rectangle:
    """A rectangle in the plane, at an angle to the axes."""

    axes: Float[np.ndarray, "2 2"]
    """Unit vectors along its sides, as rows."""
    low: Float[np.ndarray, "2"]
    """Its corners, along these axes."""
    high: Float[np.ndarray, "2"]

    def holds(self, flat: Flat, *, margin: float) -> Bool[np.ndarray, "_"]:
        """True for points in it."""
        along = flat @ self.axes.T
        return np.all((along >= self.low - margin) & (along <= self.high + margin), axis=1)

    def sheet(self, height: float) -> Mesh:
        """It, facing up."""
        along, across = (self.high - self.low)[:, None] * self.axes
        return sheet((*(self.low @ self.axes), height), (*along, 0), (*across, 0))


def find_up(points: Points, cameras: Float[np.ndarray, "view 4 4"]) -> Float[np.ndarray, "3"]:
    """Across the plane with the most points that the cameras look down on; their own up without such a plane."""
    mean = cameras[:, :3, 1].mean(axis=0)
    mean /= max(np.linalg.norm(mean), 1e-9)
    if len(points) < LEAST_POINTS:
        return mean
    near = NEAR * float(np.median(np.linalg.norm(cameras[:, :3, 3] - np.median(points, axis=0), axis=1)))
    rng, best, most = np.random.default_rng(0), mean, 0
    for _ in range(RANSAC_TRIES):
        three = points[rng.choice(len(points), 3, replace=False)]
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


def fit_room(
    points: Points, glass: Sequence[Outline], places: Float[np.ndarray, "view 3"], maps: DepthMaps | None = None
) -> Room:
    """The room that points and depth maps show.

    Args:
        glass: all objects of glass.
        places: of the cameras.
        maps: depths of opaque surfaces; without them, there are only floor and support.
    """
    middle = np.mean([outline.center for outline in glass], axis=0)
    radius = float(np.median(np.linalg.norm(places - middle, axis=1)))
    whole = points
    points = points[np.linalg.norm(points - middle, axis=1) < 20 * radius]
    for outline in glass:  # Features on glass are no room.
        points = points[~outline.around(points, times=1.25)]
    near, few = NEAR * radius, max(LEAST_POINTS, LEAST_SHARE * len(points))
    levels = _levels(points, near, few, below=float(places[:, 2].min()))
    if not levels:
        side, bottom = 3 * radius, min(outline.center[2] - outline.radii[2] for outline in glass) - GAP
        floor = sheet((middle[0] - side, middle[1] - side, bottom), (2 * side, 0, 0), (0, 2 * side, 0))
        found = f"none of {len(whole):,} points lie in a plane" if len(whole) else "no points"
        remark = f"room: {found}; using a floor below the glass"
        return Room(parts=(Part(name="floor", mesh=floor),), support=None, remark=remark)
    floor, support = levels[0], _support(levels, points, glass, near)
    parts, top = _floors(points, floor, middle, radius), None
    if support > floor + 4 * near:
        top = _smallest_rectangle(_largest_patch(points[np.abs(points[:, 2] - support) < near], CELL * radius), 1.0)
        parts.append(Part(name="table", mesh=top.sheet(support)))

    def is_thing(place: Points) -> Bool[np.ndarray, "_"]:
        """True where a surface is neither the floor nor the table."""
        kept = place[:, 2] > floor + 2 * near
        if top is not None:
            kept &= ~(top.holds(place[:, :2], margin=near) & (np.abs(place[:, 2] - support) < 2 * near))
        return kept

    rest = points[is_thing(points)]
    things: list[Mesh] = []
    if maps is not None and len(rest) >= LEAST_POINTS:
        low, high = np.percentile(rest, (1, 99), axis=0) + 4 * near * np.array([[-1], [1]])
        inner = np.clip(middle - CLOSE * radius, low, high), np.clip(middle + CLOSE * radius, low, high)

        def is_far(place: Points) -> Bool[np.ndarray, "_"]:
            return is_thing(place) & ~np.all((place > inner[0]) & (place < inner[1]), axis=1)

        if (inner[1] > inner[0]).all():
            things += fuse(maps, *inner, near / 2, is_thing)
        things += fuse(maps, low, high, COARSER * near / 2, is_far)
    parts += [Part(name=f"thing_{place}", mesh=mesh) for place, mesh in enumerate(things[:MAX_THINGS])]
    kinds = f"a floor, {'a table, ' * (top is not None)}and {len(parts)} parts in all"
    remark = f"room: {kinds} were fitted to {len(points):,} points"
    return Room(parts=tuple(parts), support=support, remark=remark)


def _levels(points: Points, near: float, few: float, *, below: float) -> list[float]:
    """Heights at which many points lie, the lowest first; each is the strongest within reach."""
    heights = points[points[:, 2] < below, 2]
    found: list[float] = []
    while len(heights) >= few:
        order = np.sort(heights)
        counts = np.searchsorted(order, order + 2 * near) - np.arange(len(order))
        best = int(counts.argmax())
        if counts[best] < few:
            break
        level = float(np.median(order[best : best + counts[best]]))
        found.append(level)
        heights = heights[np.abs(heights - level) > 4 * near]
    return sorted(found)


def _support(levels: Sequence[float], points: Points, glass: Sequence[Outline], near: float) -> float:
    """Height of the surface below the glass."""
    bottom = min(outline.center[2] - outline.radii[2] for outline in glass)
    # Cameras above cannot see where glass ends, so the masks' cones extend into its support.
    reach = max(4 * near, 0.3 * min(outline.radii[2] for outline in glass))
    counts = {level: int((np.abs(points[:, 2] - level) < near).sum()) for level in levels}
    return max((each for each in levels if abs(each - bottom) < reach), key=counts.__getitem__, default=levels[0])


def _floors(points: Points, floor: float, middle: np.ndarray, radius: float) -> list[Part]:
    """The floor as far as points show it, and unless something is below, up to four rectangles around it.

    Each is a part of its own, so that its large area takes no texels from the floor.
    """
    near = NEAR * radius
    on = points[np.abs(points[:, 2] - floor) < 2 * near]
    # The middle of the scene belongs to it, whatever points show.
    shown = _smallest_rectangle(np.concatenate([on, middle[None]]), 0.5)
    grown = MARGIN / 2 * (shown.high - shown.low)
    low, high = shown.low - grown, shown.high + grown
    pieces = [(low, high)]
    if (points[:, 2] < floor - 4 * near).mean() < MAX_BELOW:
        center = shown.axes @ middle[:2]
        first, last = np.minimum(low, center - FAR * radius), np.maximum(high, center + FAR * radius)
        pieces += [
            (first, (low[0], last[1])),
            ((high[0], first[1]), last),
            ((low[0], first[1]), (high[0], low[1])),
            ((low[0], high[1]), (high[0], last[1])),
        ]
    rectangles = [_Rectangle(axes=shown.axes, low=np.array(start), high=np.array(end)) for start, end in pieces]
    names = ("floor", *(f"floor_{place}" for place in range(4)))
    return [Part(name=name, mesh=each.sheet(floor)) for name, each in zip(names, rectangles)]


def _smallest_rectangle(points: Points, percent: float) -> _Rectangle:
    """The smallest upright rectangle around all points but few, as seen from above."""

    def at(turn: float) -> _Rectangle:
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        low, high = np.percentile(points[:, :2] @ axes.T, (percent, 100 - percent), axis=0)
        return _Rectangle(axes=axes, low=low, high=high)

    found: Iterator[_Rectangle] = map(at, np.radians(np.arange(0, 90, 2)))
    return min(found, key=lambda each: float(np.prod(each.high - each.low)))


def _largest_patch(points: Points, cell: float) -> Points:
    """The most points with no wider gaps between them than a cell."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    pairs = KDTree(points).query_pairs(cell, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    _, label = connected_components(graph, directed=False)
    return points[label == np.bincount(label).argmax()]
