"""Slits in a room: where a camera sees the sky between two walls that should meet.

Walls are the large opaque parts of a scene. Where two of them are close, rays are traced from each camera through the
gap between them; a ray that hits nothing opaque sees the sky. This finds slits of any width, at any resolution. Call
`use_mitsuba` first.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.cameras import Cameras
from datagen.data.meshes import Mesh, component_of_faces, is_there
from datagen.scene.description import Scene

WALL = 1.0
"""A part is a wall if two sides of its bounding box are longer than this many camera distances."""
WIDEST = 0.1
"""Largest width of a slit, in camera distances. Wider gaps are windows or the end of the room, and so are gaps that are
not longer than this."""
PLACES = 240
"""Largest number of rays through the gap between two walls."""
MUTUAL = 0.7
"""A gap goes from a point to the nearest point on the other wall; the way back must be at least this share as long."""
MAX_VIEWS = 120
"""Largest number of cameras to try, spread evenly over all."""
SHARES = (0.25, 0.5, 0.75)
"""Where a ray crosses the gap."""


@dataclass(frozen=True, kw_only=True)
class Slit:
    """The sky between two walls."""

    between: tuple[str, str]
    """Names of the objects; equal where both walls are parts of one."""
    width: float
    """Distance from wall to wall where the visible slit is widest, in metres."""
    place: tuple[float, float, float]
    num_views: int
    """Number of tried cameras that see it."""
    tried_views: int


def describe_slit(scene: Scene, slit: Slit) -> str:
    """A warning for the scene's author."""
    place = ", ".join(f"{value:.2f}" for value in slit.place)
    one, other = slit.between
    return (
        f"scene {scene.name}: the sky shows through a slit of {100 * slit.width:.1f} cm between {one} and {other}, "
        f"near ({place}), in {slit.num_views} of {slit.tried_views} views; if they should meet, extend one behind the "
        "other"
    )


def find_slits(scene: Scene, cameras: tuple[Cameras, ...]) -> tuple[Slit, ...]:
    """Each pair of walls between which a camera sees the sky."""
    walls = _walls(scene)
    widest = WIDEST * scene.cameras.radius
    gaps = [(one, other, *_gap(one[1], other[1], widest)) for one, other in combinations(walls, 2)]
    gaps = [gap for gap in gaps if len(gap[2])]
    if not gaps:
        return ()
    is_blocked = _occlusion(scene)
    positions, can_see = _chosen_views(cameras)
    slits = []
    for (one, _), (other, _), starts, ends in gaps:
        seen = np.zeros((len(positions), len(starts)), bool)
        for share in SHARES:
            through = starts + share * (ends - starts)
            for view, position in enumerate(positions):
                rays = np.flatnonzero(can_see(view, through))
                seen[view, rays] |= ~is_blocked(position, through[rays] - position)
        length = float(np.ptp(starts[seen.any(axis=0)], axis=0).max()) if seen.any() else 0.0
        if length > widest:
            widths = np.where(seen.any(axis=0), np.linalg.norm(ends - starts, axis=-1), 0)
            at = int(widths.argmax())
            place = tuple(((starts[at] + ends[at]) / 2).tolist())
            slits.append(
                Slit(
                    between=(one, other),
                    width=float(widths[at]),
                    place=place,
                    num_views=int(seen.any(axis=1).sum()),
                    tried_views=len(positions),
                )
            )
    return tuple(slits)


def _walls(scene: Scene) -> list[tuple[str, np.ndarray]]:
    """Name and triangles (face, 3, 3) of each large opaque part."""
    walls = []
    for item in scene.objects:
        if not is_there(item.mesh) or item.material.is_glass or not _is_large(item.mesh.vertices, scene):
            continue
        part = component_of_faces(item.mesh)
        corners = item.mesh.vertices[item.mesh.faces].astype(np.float64)
        for index in range(int(part.max()) + 1):
            mine = corners[part == index]
            if _is_large(mine.reshape(-1, 3), scene):
                walls.append((item.name, mine))
    return walls


def _is_large(points: np.ndarray, scene: Scene) -> bool:
    return float(np.sort(np.ptp(points, axis=0))[1]) > WALL * scene.cameras.radius


def _gap(
    one: Float[np.ndarray, "face 3 3"], other: Float[np.ndarray, "other_face 3 3"], widest: float
) -> tuple[Float[np.ndarray, "place 3"], Float[np.ndarray, "place 3"]]:
    """Points on one wall and the nearest points on the other, where the walls are close but do not touch.

    Light through a gap passes its rim, which is an edge of one of the walls, so checking edges is enough.
    """
    starts, ends = [], []
    for mine, theirs in ((one, other), (other, one)):
        low, high = theirs.min(axis=(0, 1)) - widest, theirs.max(axis=(0, 1)) + widest
        points = _on_edges(mine, widest / 8, low, high)
        if len(points) == 0:
            continue
        points = points[np.unique(np.linspace(0, len(points) - 1, PLACES // 2).astype(np.int64))]
        mine, theirs = (
            _in_box(wall, points.min(axis=0) - widest, points.max(axis=0) + widest) for wall in (mine, theirs)
        )
        if len(mine) == 0 or len(theirs) == 0:
            continue
        nearest = np.stack([_nearest_on(point, theirs) for point in points])
        width = np.linalg.norm(nearest - points, axis=-1)
        back = np.stack([_nearest_on(point, mine) for point in nearest])
        # Where one wall adjoins another, its edge runs away from there: not a gap, since the wall itself is nearer.
        crosses = np.linalg.norm(nearest - back, axis=-1) > MUTUAL * width
        kept = (width > 1e-6) & (width < widest) & crosses
        starts.append(points[kept])
        ends.append(nearest[kept])
    nothing = np.zeros((0, 3))
    return np.concatenate([nothing, *starts]), np.concatenate([nothing, *ends])


def _on_edges(
    corners: Float[np.ndarray, "face 3 3"], spacing: float, low: np.ndarray, high: np.ndarray
) -> Float[np.ndarray, "point 3"]:
    """Points along the edges of triangles inside a box, without repeats, sorted by position."""
    start, end = corners.reshape(-1, 3), np.roll(corners, -1, axis=1).reshape(-1, 3)
    meets = ((np.minimum(start, end) <= high) & (np.maximum(start, end) >= low)).all(axis=-1)
    # Two triangles traverse their edge in opposite directions, only one that at the rim of an open wall. All edges are
    # turned to one direction, so that repeats have the same points.
    ranks = [ends[:, 0] * 7.1 + ends[:, 1] * 3.3 + ends[:, 2] for ends in (start, end)]
    forward, backward = meets & (ranks[0] <= ranks[1]), meets & (ranks[0] > ranks[1])
    start, end = (np.concatenate([one[forward], other[backward]]) for one, other in ((start, end), (end, start)))
    steps = np.ceil(np.linalg.norm(end - start, axis=-1) / spacing).astype(np.int64) + 1
    edge = np.repeat(np.arange(len(start)), steps)
    step = np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps)
    share = (step / np.maximum(steps - 1, 1)[edge])[:, None]
    points = start[edge] + share * (end - start)[edge]
    points = points[((points >= low) & (points <= high)).all(axis=-1)]
    # One point per cell of the spacing is enough.
    _, kept = np.unique(np.floor(points / spacing).astype(np.int64), axis=0, return_index=True)
    return points[kept]


def _in_box(corners: Float[np.ndarray, "face 3 3"], low: np.ndarray, high: np.ndarray) -> Float[np.ndarray, "near 3 3"]:
    """The triangles whose bounding box meets a box."""
    return corners[((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=-1)]


def _nearest_on(point: Float[np.ndarray, "3"], corners: Float[np.ndarray, "face 3 3"]) -> Float[np.ndarray, "3"]:
    """The point on some triangles that is nearest to a point."""
    a = corners[:, 0]
    normals = np.cross(corners[:, 1] - a, corners[:, 2] - a)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    foot = point - np.einsum("fc,fc->f", point - a, normals)[:, None] * normals
    is_over = np.ones(len(corners), bool)
    candidates = []
    for start in range(3):
        corner, edge = corners[:, start], corners[:, (start + 1) % 3] - corners[:, start]
        share = np.clip(np.einsum("fc,fc->f", point - corner, edge) / np.einsum("fc,fc->f", edge, edge), 0, 1)
        candidates.append(corner + share[:, None] * edge)
        is_over &= np.einsum("fc,fc->f", np.cross(normals, edge), point - corner) >= 0
    points = np.concatenate([foot[is_over], *candidates])
    return points[np.linalg.norm(points - point, axis=-1).argmin()]


def _chosen_views(cameras: tuple[Cameras, ...]):
    """Positions of some cameras of all splits, and a function that tests which points are in a camera's picture."""
    everyone = [split[view] for split in cameras for view in range(len(split))]
    chosen = np.unique(np.linspace(0, len(everyone) - 1, MAX_VIEWS).astype(np.int64))
    some = [everyone[view] for view in chosen]

    def can_see(view: int, points: Float[np.ndarray, "place 3"]) -> Bool[np.ndarray, " place"]:
        pixels, depth = some[view].project(points)
        inside = (pixels >= 0) & (pixels <= (some[view].width, some[view].height))
        return (depth > 0) & inside.all(axis=1)

    return np.stack([camera.world_from_camera[:3, 3] for camera in some]), can_see


def _occlusion(scene: Scene):
    """A function that tests which rays from a position, along directions (ray, 3), hit something opaque."""
    import mitsuba as mi

    from datagen.render.mitsuba_scene import is_scalar, load_geometry_mitsuba, to_columns

    meshes: tuple[Mesh, ...] = tuple(
        item.mesh for item in scene.objects if is_there(item.mesh) and not item.material.is_glass
    )
    loaded = load_geometry_mitsuba(meshes)

    def is_blocked(position: np.ndarray, directions: np.ndarray) -> Bool[np.ndarray, " ray"]:
        if not len(directions):
            return np.zeros(0, bool)  # Dr.Jit 1.5 aborts on zero rays.
        if is_scalar():
            rays = (mi.Ray3f(position.tolist(), direction.tolist()) for direction in directions)
            return np.array([loaded.ray_test(ray) for ray in rays], bool)
        origins = np.broadcast_to(position, directions.shape)
        rays = mi.Ray3f(mi.Point3f(*to_columns(origins)), mi.Vector3f(*to_columns(directions)))
        return np.array(loaded.ray_test(rays), bool)

    return is_blocked
