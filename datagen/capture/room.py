"""Fits an opaque room to points and depth maps: a floor, the support of the glass, walls, and things.

Things are the surfaces that depth maps show, and boxes around points where they show none. Points are in metres with z
up. Of every surface only its front counts, which a texture is learned for; what no points show (plain walls) is left
to the sky.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from datagen.capture.fusing import fuse
from datagen.capture.outlines import Outline
from datagen.capture.stereo import DepthMaps
from datagen.data.meshes import Mesh
from datagen.scene.modelling import moved, rotation, rounded_box, sheet, transformed

Points = Float[np.ndarray, "_ 3"]
Flat = Float[np.ndarray, "_ 2"]

NEAR = 0.012
"""Distance from a surface that counts as on it, over the cameras' distance; so are the next lengths."""
FARTHER = 2.5
"""Tolerance for walls: they are far away, so points on them are less accurate."""
CELL = 0.05
"""Side of the cells by whose contact points are one thing."""
LEAST_WALL = (0.5, 0.2)
"""Length and height of the smallest wall."""
LEAST_SHARE = 0.01
"""Share of all points on a floor or a wall."""
LEAST_POINTS = 25
"""Points that make a thing."""
MAX_BEHIND = 0.05
"""Share of the points that may lie behind a wall: they were seen in a mirror, or matched wrongly."""
BINS = 10
"""Parts of a wall; points lie on most of them, as they do not on a line through two things."""
MAX_WALLS, MAX_THINGS = 4, 24
FOUND = 0.5
"""Share of a thing's points near surfaces from depth maps, above which it needs no box."""
MARGIN = 0.15
"""Margin added around the points of a floor or wall, relative to their extent."""
SLAB = 0.04
"""Thickness of a table top over its narrow side."""
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


def fit_room(
    points: Points, glass: Sequence[Outline], places: Float[np.ndarray, "view 3"], maps: DepthMaps | None = None
) -> Room:
    """The room that points and depth maps show.

    Args:
        places: of the cameras.
        maps: depths of opaque surfaces; without them, things are boxes.
    """
    middle = np.mean([outline.center for outline in glass], axis=0)
    radius = float(np.median(np.linalg.norm(places - middle, axis=1)))
    bottom = min(outline.center[2] - outline.radii[2] for outline in glass)
    whole = points
    points = points[np.linalg.norm(points - middle, axis=1) < 20 * radius]
    for outline in glass:
        # Features on glass are no room. The ellipsoid of a pane or a plate holds what is on it, too.
        if outline.radii[2] > 0.5 * max(outline.radii[:2]):
            points = points[~outline.around(points, times=1.25)]
    near, few = NEAR * radius, max(LEAST_POINTS, LEAST_SHARE * len(points))
    levels = _levels(points, near, few, below=float(places[:, 2].min()))
    if not levels:
        side = 3 * radius
        floor = sheet((middle[0] - side, middle[1] - side, bottom), (2 * side, 0, 0), (0, 2 * side, 0))
        remark = f"room: none of {len(whole):,} points lie in a plane; it is a floor below the glass, --room gives more"
        return Room(parts=(Part(name="floor", mesh=floor),), support=None, remark=remark)
    floor, rest = levels[0], points[points[:, 2] > levels[0] + 2 * near]
    parts: list[Part] = []
    top: Rectangle | None = None
    # Cameras above cannot see where glass ends, so the masks' cones extend into its support.
    reach = max(4 * near, 0.3 * min(outline.radii[2] for outline in glass))
    counts = {level: int((np.abs(points[:, 2] - level) < near).sum()) for level in levels}
    support = max((level for level in levels if abs(level - bottom) < reach), key=counts.__getitem__, default=floor)
    if support > floor + 4 * near:
        on = np.abs(rest[:, 2] - support) < near
        top = _rectangle(_largest_thing(rest[on], CELL * radius)[:, :2], 1.0)
        parts.append(Part(name="table", mesh=_board(top, support, below=floor, points=rest, near=near)))
        rest = rest[~(top.holds(rest[:, :2], margin=near) & (rest[:, 2] < support + 2 * near))]
    walls, rest = _walls(rest, places, middle, radius, few)
    parts += [_wall(f"wall_{place}", wall, walls, floor) for place, wall in enumerate(walls)]
    ground = _floor(points[np.abs(points[:, 2] - floor) < 2 * near], walls, middle)
    parts.insert(0, Part(name="floor", mesh=ground.sheet(floor)))

    def is_thing(place: Points) -> Bool[np.ndarray, "_"]:
        """True where a surface is neither the floor, the table nor a wall."""
        kept = place[:, 2] > floor + 2 * near
        if top is not None:
            kept &= ~(top.holds(place[:, :2], margin=near) & (np.abs(place[:, 2] - support) < 2 * near))
        for wall in walls:
            kept &= wall.ahead(place[:, :2]) > FARTHER * near
        return kept

    things: list[Mesh] = []
    if maps is not None and len(rest) >= LEAST_POINTS:
        low, high = np.percentile(rest, (1, 99), axis=0) + 4 * near * np.array([[-1], [1]])
        things = fuse(maps, low, high, near / 2, is_thing)[:MAX_THINGS]
    parts += [Part(name=f"thing_{place}", mesh=mesh) for place, mesh in enumerate(things)]
    boxes = []
    for thing in _things(_far_from(things, rest, CELL * radius, 2 * near), CELL * radius):
        box = _rectangle(thing[:, :2])
        foot, head = np.percentile(thing[:, 2], (2, 98)).tolist()
        base = support if foot > support - 2 * near else floor
        # Points at its foot may be missing; something on a glass table has no surface below it.
        bottom = base if foot - base < 0.5 * (head - foot) else foot
        if head - bottom > 2 * near and min(box.half) > near / 2 and not _holds_camera(box, head, places):
            boxes.append(Part(name=f"box_{len(boxes)}", mesh=_standing(box, bottom, head)))
    parts += boxes[: MAX_THINGS - len(things)]
    kinds = f"a floor, {'a table, ' * (support > floor + 4 * near)}{len(walls)} walls and {len(parts[1:])} parts in all"
    remark = f"room: {kinds} were fitted to {len(points):,} points; --room takes meshes instead"
    return Room(parts=tuple(parts), support=support, remark=remark)


# Levels


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


def _far_from(meshes: Sequence[Mesh], points: Points, cell: float, near: float) -> Points:
    """The points of things that meshes do not show."""
    from scipy.spatial import KDTree

    if not meshes:
        return points
    surface = KDTree(np.concatenate([mesh.vertices for mesh in meshes]))
    others = [thing for thing in _things(points, cell) if (surface.query(thing)[0] < near).mean() < FOUND]
    return np.concatenate([points[:0], *others])


def _largest_thing(points: Points, cell: float) -> Points:
    return max(_things(points, cell, least=1), key=len, default=points)


def _things(points: Points, cell: float, least: int = LEAST_POINTS) -> Iterator[Points]:
    """Points that are one thing: in cells that touch; things of few points are left out."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if not len(points):
        return
    pairs = KDTree(points).query_pairs(cell, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    count, label = connected_components(graph, directed=False)
    sizes = np.bincount(label, minlength=count)
    for index in np.argsort(-sizes, kind="stable"):
        if sizes[index] >= least:
            yield points[label == index]


# Rectangles seen from above


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


def _rectangle(flat: Flat, percent: float = 2.0, angle: float | None = None) -> Rectangle:
    """The smallest rectangle around all points but few."""
    angles = np.radians(np.arange(0, 90, 2)) if angle is None else [angle]
    best = None
    for turn in angles:
        c, s = np.cos(turn), np.sin(turn)
        axes = np.array([[c, s], [-s, c]])
        low, high = np.percentile(flat @ axes.T, (percent, 100 - percent), axis=0)
        if best is None or np.prod(high - low) < np.prod(2 * np.array(best.half)):
            center = (low + high) / 2 @ axes
            best = Rectangle(center=tuple(center), half=tuple((high - low) / 2), angle=float(turn))
    assert best is not None
    return best


def _standing(base: Rectangle, low: float, high: float) -> Mesh:
    size = (2 * base.half[0], 2 * base.half[1], high - low)
    box = rounded_box(size, bevel=0.02 * min(size), segments=1)
    turned = transformed(box, rotation((0, 0, 1), float(np.degrees(base.angle))), (0, 0, 0))
    return moved(turned, (*base.center, (low + high) / 2))


def _board(top: Rectangle, height: float, *, below: float, points: Points, near: float) -> Mesh:
    """A table: solid to the floor where points show its sides, a thin board otherwise."""
    under = (points[:, 2] > below + 3 * near) & (points[:, 2] < height - 6 * near)
    sides = under & top.holds(points[:, :2], margin=near)
    low = below if sides.sum() >= LEAST_POINTS else height - SLAB * 2 * min(top.half)
    return _standing(top, low, height)


def _holds_camera(base: Rectangle, high: float, places: Float[np.ndarray, "view 3"]) -> bool:
    return bool((base.holds(places[:, :2]) & (places[:, 2] < high)).any())


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


def _walls(
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


def _wall(name: str, wall: Wall, walls: Sequence[Wall], floor: float) -> Part:
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
    return Part(name=name, mesh=_facing(mesh, np.array([*wall.normal, 0.0])))


def _facing(mesh: Mesh, normal: np.ndarray) -> Mesh:
    if mesh.normals[0] @ normal > 0:
        return mesh
    return Mesh(vertices=mesh.vertices, faces=mesh.faces[:, ::-1].copy(), normals=-mesh.normals, uv=mesh.uv)


def _floor(points: Points, walls: Sequence[Wall], middle: np.ndarray) -> Rectangle:
    """The floor: along the first wall, as far as points show it and a little farther, and not beyond walls."""
    angle = float(np.arctan2(walls[0].along[1], walls[0].along[0])) if walls else None
    # The middle of the scene belongs to it, whatever points show.
    base = _rectangle(np.concatenate([points[:, :2], middle[None, :2]]), 0.5, angle)
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


def _samples(rng: np.random.Generator, points: np.ndarray, count: int) -> Iterator[np.ndarray]:
    for _ in range(RANSAC_TRIES):
        yield points[rng.choice(len(points), count, replace=False)]
