"""Fits an opaque room to points and depth maps: a floor, support, walls, things; finds where glass is by its masks.

Things are the surfaces that depth maps show. Points are in metres with z up. Of every surface only its front counts,
which a texture is learned for; what no depth map shows (plain walls) is left to the sky.

Upright ellipsoids replace the true meshes of glass until `model fit` finds them. Panes are level objects so thin that
they hardly displace the view through them: depth maps look through them. Thick or round glass shifts, and is left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from datagen.data.cameras import Camera, Cameras
from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.modelling import sheet
from hyaline_photos.capture.planes import (
    FAR,
    FARTHER,
    LEAST_POINTS,
    LEAST_SHARE,
    MAX_BEHIND,
    NEAR,
    Flat,
    Points,
    Rectangle,
    Wall,
    box_on,
    down_to,
    find_walls,
    floor_within,
    smallest_rectangle,
    wall_mesh,
)
from hyaline_photos.capture.stereo import DepthMaps, fuse
from hyaline_photos.fit.boxes import fit_box
from hyaline_photos.fit.views import Sightings, as_convex, rays_near

# Places of glass

LEAST_VIEWS = 3
LEAST_PIXELS = 8
"""Smaller masks are left out: they say little, and are often wrong."""
GAP = 0.0005
"""Gap in metres between glass and opaque surfaces that it touches."""
SIDE = 40
"""Points a side of the grid that is carved."""
MAX_OUTSIDE = 0.1
"""Share of the views that may see no glass at a point of an object: masks err, and opaque things hide glass."""
MAX_HIDDEN = 0.35
"""The same, with views that see another object of glass there, which may be in front of it."""
MIN_SHOWN = 0.5
"""Least share of the views that show the object at a point of it, relative to its best point, where other glass hides
it in more views than that."""
ROOMY = 1.6
"""Side of the first grid over the object's estimated size."""
MAX_THICKNESS = 0.1
"""Thickness of a pane over its narrower side."""


@dataclass(frozen=True, kw_only=True)
class Outline:
    """An upright ellipsoid."""

    name: str
    center: tuple[float, float, float]
    radii: tuple[float, float, float]

    def moved(self, scale: float, offset: Float[np.ndarray, "3"]) -> "Outline":
        """The same after scaling the world and moving it."""
        center, radii = scale * np.array(self.center) + offset, scale * np.array(self.radii)
        return replace(self, center=tuple(center.tolist()), radii=tuple(radii.tolist()))

    def standing_on(self, height: float) -> "Outline":
        """The same above a surface, below which cameras see nothing; as it is if it does not reach into that."""
        low, high = self.center[2] - self.radii[2], self.center[2] + self.radii[2]
        if not low < height < self.center[2]:
            return self
        low = height + GAP
        center, radii = (*self.center[:2], (low + high) / 2), (*self.radii[:2], (high - low) / 2)
        return replace(self, center=center, radii=radii)


def is_shown(pixels: Sequence[int]) -> bool:
    """Whether enough pictures show an object, by the number of pixels in each."""
    return sum(count >= LEAST_PIXELS for count in pixels) >= LEAST_VIEWS


def find_outline(
    name: str, index: int, ids: Sequence[UInt8[np.ndarray, "h w"]], cameras: Cameras, *, where: str
) -> Outline:
    """The outline of an object.

    Args:
        index: its number in `ids`, which say what each pixel sees; 0: no glass; one picture a camera.
    """
    seen = [view for view, picture in enumerate(ids) if (picture == index).sum() >= LEAST_PIXELS]
    if len(seen) < LEAST_VIEWS:
        raise HyalineError(
            f"{where}: shows its object in {len(seen)} of {len(ids)} pictures; expected at least {LEAST_VIEWS}: check "
            "that its masks are white where the object is, or remove the folder"
        )
    middle, size = _first_guess([(cameras[view], ids[view] == index) for view in seen])
    low, high = middle - ROOMY * size / 2, middle + ROOMY * size / 2
    cell, inside = (high - low) / (SIDE - 1), np.zeros((0, 3))
    for _ in range(2):
        cell = (high - low) / (SIDE - 1)
        points = low + np.argwhere(np.ones((SIDE,) * 3)) * cell
        inside = points[_is_inside(points, index, ids, cameras)]
        if not len(inside):
            raise HyalineError(
                f"{where}: its masks do not meet in space; check that they show one object, and that the cameras are "
                "those of the pictures"
            )
        low, high = inside.min(axis=0) - cell, inside.max(axis=0) + cell
    # Each grid point represents its cell; masks are least reliable at the outermost ones.
    low, high = np.percentile(inside, (0.4, 99.6), axis=0) + np.array([[-0.5], [0.5]]) * cell
    return Outline(name=name, center=tuple((low + high) / 2), radii=tuple((high - low) / 2))


def _first_guess(masks: Sequence[tuple[Camera, Bool[np.ndarray, "h w"]]]) -> tuple[Float[np.ndarray, "3"], float]:
    """The point nearest to the rays through the masks' middles, by the mean of its distance; and the size there."""
    from scipy.optimize import minimize

    place = np.stack([camera.world_from_camera[:3, 3] for camera, _ in masks])
    ahead = np.stack([camera.rays()[1][mask].mean(axis=0).astype(np.float64) for camera, mask in masks])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    sizes = [max(np.ptp(np.nonzero(mask), axis=1)) / camera.focal for camera, mask in masks]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    start = np.linalg.lstsq(across.sum(axis=0), np.einsum("vij,vj->i", across, place), rcond=None)[0]
    point = minimize(lambda p: np.linalg.norm(np.cross(p - place, ahead), axis=1).mean(), start, method="Powell").x
    return point, float(np.percentile(np.linalg.norm(point - place, axis=1) * sizes, 75))


def _is_inside(
    points: Float[np.ndarray, "point 3"], index: int, ids: Sequence[UInt8[np.ndarray, "h w"]], cameras: Cameras
) -> Bool[np.ndarray, " point"]:
    """Points that hardly any view denies."""
    yes, empty, views = (np.zeros(len(points), np.int32) for _ in range(3))
    for view, picture in enumerate(ids):
        camera = cameras[view]
        pixel, depth = camera.project(points)
        column, row = np.floor(pixel).astype(np.int64).T
        shown = (depth > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        found = picture[np.where(shown, row, 0), np.where(shown, column, 0)]
        yes += shown & (found == index)
        empty += shown & (found == 0)
        views += shown
    inside = (yes >= LEAST_VIEWS) & (empty <= MAX_OUTSIDE * views)
    if (is_open := inside & (views - yes <= MAX_HIDDEN * views)).any():
        return is_open
    # A drink, or glass behind other glass: views that show that first deny nothing.
    return inside & (yes >= MIN_SHOWN * yes[inside].max(initial=0))


# Panes


@dataclass(frozen=True, kw_only=True)
class Pane:
    """A level pane."""

    name: str
    footprint: Rectangle
    top: float
    thickness: float

    def outline(self) -> Outline:
        """An upright ellipsoid of the same size."""
        reach = np.abs(self.footprint.axes.T) @ self.footprint.half
        return Outline(
            name=self.name,
            center=(*self.footprint.center, self.top - self.thickness / 2),
            radii=(*reach.tolist(), self.thickness / 2),
        )

    def without(self, mesh: Mesh) -> Mesh:
        """A surface with its vertices inside the pane, where nothing can be, moved out through the nearer face."""
        vertices, bottom = mesh.vertices.copy(), self.top - self.thickness
        inside = self.footprint.holds(vertices[:, :2]) & (vertices[:, 2] > bottom) & (vertices[:, 2] < self.top)
        below = vertices[:, 2] < self.top - self.thickness / 2
        vertices[inside & below, 2] = bottom - GAP
        vertices[inside & ~below, 2] = self.top + GAP
        return replace(mesh, vertices=vertices)


def find_panes(
    outlines: Sequence[Outline], ids: Sequence[UInt8[np.ndarray, "h w"]], cameras: Cameras
) -> tuple[Pane, ...]:
    """The objects that are panes: upright boxes, by their masks, that are flat.

    Args:
        outlines: of all objects.
        ids: 1 + the place among the outlines of the object that each pixel sees, 0 elsewhere; one picture a camera.
    """
    first, panes = np.stack(ids), []
    depth, unknown = np.full(first.shape, np.inf, np.float32), tuple(range(1, len(outlines) + 1))
    sightings = Sightings(cameras=cameras, first=first, touched=first > 0, depth=depth, unknown=unknown)
    for object_id, outline in enumerate(outlines, start=1):
        box = fit_box(rays_near(as_convex(sightings, object_id), object_id), np.array([0.0, 0.0, 1.0]))
        if box is None:
            continue
        half, angle = box.half_sizes.tolist(), float(np.arctan2(box.axes[0, 1], box.axes[0, 0]))
        if half[2] < MAX_THICKNESS * min(half[:2]):
            footprint = Rectangle(center=(box.center[0], box.center[1]), half=(half[0], half[1]), angle=angle)
            top = float(box.center[2] + half[2])
            panes.append(Pane(name=outline.name, footprint=footprint, top=top, thickness=2 * half[2]))
    return tuple(panes)


# The room

CELL = 0.05
"""Largest distance between neighbouring points of a table top, over the cameras' distance."""
MAX_THINGS = 24
THING = "thing_"
"""How the names of surfaces from depth maps begin."""
STRIDE, ELSEWHERE = 4, 0.1
"""Pixels between those of depth maps that a room is compared with, and the relative difference that counts as none."""
SLAB = 0.04
"""Thickness of a table top over its narrow side."""


@dataclass(frozen=True, kw_only=True)
class Room:
    """All parts by name, including the support of the glass."""

    parts: dict[str, Mesh]
    support: float | None
    """Height of the surface below the glass; None where no points show one."""
    remark: str


def fit_room(
    points: Points,
    glass: Sequence[Outline],
    places: Float[np.ndarray, "view 3"],
    maps: DepthMaps | None = None,
    panes: Sequence[Pane] = (),
) -> Room:
    """The room that points and depth maps show.

    Args:
        glass: all objects of glass.
        places: of the cameras.
        maps: depths of opaque surfaces; without them, there are no things.
        panes: the objects that are panes.
    """
    from trimesh.grouping import clusters

    middle = np.mean([outline.center for outline in glass], axis=0)
    radius = float(np.median(np.linalg.norm(places - middle, axis=1)))
    # Glass may stand on panes; without other glass, the panes themselves stand on something.
    flat = {pane.name for pane in panes}
    standing = [outline for outline in glass if outline.name not in flat] or glass
    whole = points
    points = points[np.linalg.norm(points - middle, axis=1) < 20 * radius]
    near, few = NEAR * radius, max(LEAST_POINTS, LEAST_SHARE * len(points))
    levels = _levels(points, near, few, below=float(places[:, 2].min()))
    if not levels:
        side, bottom = 3 * radius, min(outline.center[2] - outline.radii[2] for outline in glass) - GAP
        floor = sheet((middle[0] - side, middle[1] - side, bottom), (2 * side, 0, 0), (0, 2 * side, 0))
        found = f"none of {len(whole):,} points lie in a plane" if len(whole) else "no points"
        remark = f"room: {found}; using a floor below the glass"
        return Room(parts={"floor": floor}, support=None, remark=remark)
    floor, rest = levels[0], points[points[:, 2] > levels[0] + 2 * near]
    parts: dict[str, Mesh] = {}
    top: Rectangle | None = None
    support, is_pane = _support(levels, points, standing, panes, near)
    if support > floor + 4 * near and not is_pane:
        on = rest[np.abs(rest[:, 2] - support) < near]
        most = max(clusters(on, CELL * radius), key=len, default=slice(None))
        top = smallest_rectangle(on[most, :2], 1.0)
        parts["table"] = box_on(top, support - SLAB * 2 * min(top.half), support)
        rest = rest[~(top.holds(rest[:, :2], margin=near) & (rest[:, 2] < support + 2 * near))]
    ground = points[np.abs(points[:, 2] - floor) < 2 * near, :2]
    walls, rest = find_walls(rest, ground, places, middle, radius, few)
    parts |= {f"wall_{place}": wall_mesh(wall, walls, floor) for place, wall in enumerate(walls)}
    parts = _floors(points, ground, floor, walls, middle, radius) | parts

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
        for pane in panes:
            things = [pane.without(thing) for thing in things]
        if top is not None:
            things = [down_to(support, thing, 3 * near, top) for thing in things]
        things = [down_to(floor, thing, 3 * near) for thing in things]
    parts |= {f"{THING}{place}": mesh for place, mesh in enumerate(things)}
    kinds = f"a floor, {'a table, ' * (top is not None)}{len(walls)} walls and {len(parts) - 1} parts in all"
    remark = f"room: {kinds} were fitted to {len(points):,} points"
    return Room(parts=parts, support=support, remark=remark)


def lacking(parts: Mapping[str, Mesh], maps: DepthMaps) -> Float[np.ndarray, " view"]:
    """Share of what each depth map shows that a room lacks or has elsewhere; 0 where it shows nothing."""
    use_mitsuba()
    from datagen.trace.peel import Peeler

    peeler, shares = Peeler(tuple(parts.values())), []
    for view, depth in enumerate(maps.depth):
        camera, found = maps.cameras[view], depth[::STRIDE, ::STRIDE]
        origin, directions = camera.rays()
        directions = directions[::STRIDE, ::STRIDE][found > 0]
        hits = peeler.trace(origin, directions, 1)
        along = hits.t[0] * (directions @ -camera.world_from_camera[:3, 2])
        is_there = (hits.shape[0] >= 0) & (np.abs(along - found[found > 0]) < ELSEWHERE * along)
        shares.append(1 - is_there.mean() if len(is_there) else 0.0)
    return np.array(shares)


# Levels


def _support(
    levels: Sequence[float], points: Points, standing: Sequence[Outline], panes: Sequence[Pane], near: float
) -> tuple[float, bool]:
    """Height of the surface below the glass, and whether that is a pane."""
    bottom = min(outline.center[2] - outline.radii[2] for outline in standing)
    # Cameras above cannot see where glass ends, so the masks' cones extend into its support.
    reach = max(4 * near, 0.3 * min(outline.radii[2] for outline in standing))
    names = {outline.name for outline in standing}
    tops = [pane.top for pane in panes if pane.name not in names and abs(pane.top - bottom) < reach]
    if tops:
        return max(tops), True
    close = [level for level in levels if abs(level - bottom) < reach]
    return max(close, key=lambda level: (np.abs(points[:, 2] - level) < near).sum(), default=levels[0]), False


def _floors(
    points: Points, ground: Flat, floor: float, walls: Sequence[Wall], middle: np.ndarray, radius: float
) -> dict[str, Mesh]:
    """The floor as far as points show it, and what lies around it and before the walls unless something is below."""
    parts = {"floor": floor_within(ground, walls, middle).sheet(floor)}
    if (points[:, 2] < floor - 4 * NEAR * radius).mean() < MAX_BEHIND:
        corners = middle[:2] + FAR * radius * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
        # A part of its own, a little lower, so that its large area takes no texels from the floor.
        parts["floor_around"] = floor_within(corners, walls, middle).sheet(floor - GAP)
    return parts


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
