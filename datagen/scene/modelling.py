"""Procedural shapes for scenes: closed and oriented outward (except sheets), smooth except at creases.

All lengths are metres, +z is up. Shapes have no uv yet (all 0): `datagen.scene.atlas` unwraps finished objects.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from datagen.data.meshes import Mesh, mesh_from
from datagen.scene.shading_normals import corner_normals, split_corners

Point = tuple[float, float, float]
Points = Float[np.ndarray, "p 3"]
Profile = Sequence[tuple[float, float]]
"""Points (radius, z) of a lathe's outline."""
Around = Callable[[Float[np.ndarray, " angle"], Float[np.ndarray, "p 2"]], Float[np.ndarray, "p angle"]]
"""Maps angles in radians and an outline's points to factors on their radii, for sections that are not circles."""

Part = Mesh | tuple[Mesh, Sequence[float]]
"""A part of a mesh, or one with the place that it is moved to."""

CREASE_DEG = 40.0
"""Faces that meet at a sharper angle than this are shaded with a hard edge."""


# Solids


def rounded_box(size: Point, *, bevel: float, segments: int = 3) -> Mesh:
    """A box centred on the origin, its edges rounded with radius `bevel` in `segments` steps per 45 degrees."""
    half = np.asarray(size, np.float64) / 2
    assert 0 < bevel < half.min(), f"bevel {bevel} of a box {size}"
    # Grid lines per side: evenly spaced angles on the rounded edge; the last is exact, so that faces meet bit for bit.
    steps = np.tan(np.linspace(0, np.pi / 4, segments + 1))
    steps[-1] = 1.0
    lines = [np.concatenate([-(h - bevel + bevel * steps[::-1]), h - bevel + bevel * steps]) for h in half]
    positions, faces = [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1, 1):
            grid = np.empty((len(lines[u]), len(lines[v]), 3))
            grid[..., axis] = side * half[axis]
            grid[..., u], grid[..., v] = lines[u][:, None], lines[v][None, :]
            quads = grid_faces(*grid.shape[:2]) + sum(map(len, positions))
            positions.append(grid.reshape(-1, 3))
            faces.append(quads if side > 0 else quads[:, ::-1])
    on_cube, index = np.unique(np.concatenate(positions), axis=0, return_inverse=True)
    core = np.clip(on_cube, bevel - half, half - bevel)
    normals = on_cube - core
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return mesh_from(core + bevel * normals, index.reshape(-1)[np.concatenate(faces)], normals)


def ball(radius: float, *, subdivisions: int = 4) -> Mesh:
    """A geodesic sphere around the origin with exact normals: 20 * 4^subdivisions faces."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions)
    directions = sphere.vertices / np.linalg.norm(sphere.vertices, axis=-1, keepdims=True)
    return mesh_from(radius * directions, np.asarray(sphere.faces), directions)


def lathe(
    profile: Profile, *, segments: int = 96, crease_deg: float = CREASE_DEG, around: Around | None = None
) -> Mesh:
    """The solid that an outline (radius, z) sweeps around the z axis, in circles unless `around` is given.

    The outline either starts and ends on the axis, or closes on itself off the axis (a ring). Its direction does not
    matter: the solid is oriented outward. Ends on the axis are one vertex each, so the solid is watertight there.
    """
    outline = np.asarray(profile, np.float64)
    assert (outline[:, 0] >= 0).all(), "a radius is negative"
    angles = np.arange(segments) * (2 * np.pi / segments)
    factors = np.ones((len(outline), segments)) if around is None else around(angles, outline)
    outline, factors = np.hsplit(_with_end_rings(outline, factors, crease_deg), [2])
    area = np.sum(outline[:, 0] * np.roll(outline[:, 1], -1) - np.roll(outline[:, 0], -1) * outline[:, 1])
    if area < 0:
        outline, factors = outline[::-1], factors[::-1]
    on_axis = outline[:, 0] == 0
    is_ring = not on_axis.any()
    assert is_ring or (on_axis[[0, -1]].all() and on_axis.sum() == 2), "only the outline's ends may be on the axis"

    positions, rings = [], []
    for (radius, z), factor in zip(outline, factors):
        radii = radius * factor
        ring = np.stack([radii * np.cos(angles), radii * np.sin(angles), np.full(segments, z)], axis=-1)
        ring = ring if radius > 0 else ring[:1]
        rings.append(sum(map(len, positions)) + np.arange(segments) % len(ring))
        positions.append(ring)
    following = rings[1:] + rings[:1] if is_ring else rings[1:]
    faces = [_band(low, high) for low, high in zip(rings, following)]
    return shaded(np.concatenate(positions), np.concatenate(faces), crease_deg=crease_deg)


def _with_end_rings(outline: np.ndarray, factors: np.ndarray, crease_deg: float) -> np.ndarray:
    """Both side by side, with a point more wherever a part meets a smooth corner that is less than a third as long.

    The normals of a corner lean: without a ring near it, all of a long wall would refract as if it were curved.
    """
    points = np.concatenate([outline, factors], axis=-1)[[*range(len(outline)), 0]]
    edges, first = np.diff(points[:, :2], axis=0), np.arange(len(outline))
    lengths, places = np.linalg.norm(edges, axis=-1), [first]
    for shift in (1, -1):
        beside = np.roll(lengths, shift)
        cosine = (edges * np.roll(edges, shift, axis=0)).sum(axis=-1)
        is_long = (beside < lengths / 3) & (cosine > np.cos(np.radians(crease_deg)) * lengths * beside)
        share = beside[is_long] / lengths[is_long]
        places.append(first[is_long] + (share if shift == 1 else 1 - share))
    place = np.sort(np.concatenate(places))
    place = place[place <= len(outline) - (outline[0, 0] == 0), None]  # None on the axis.
    before = place.astype(np.int64).ravel()
    return points[before] + (place - before[:, None]) * (points[before + 1] - points[before])


def cylinder(
    radius: float, height: float, *, top_radius: float | None = None, bevel: float = 0.002, segments: int = 48
) -> Mesh:
    """An upright cylinder or truncated cone with rounded edges, from z = 0 to z = height."""
    top = radius if top_radius is None else top_radius
    outline = filleted([(0, 0, 0), (radius, 0, bevel), (top, height, bevel), (0, height, 0)])
    return lathe(outline, segments=segments)


def tube(path: Points, radius: float | np.ndarray, *, segments: int = 16, is_loop: bool = False) -> Mesh:
    """A pipe along a path of points with one radius each; its ends are flat unless it is a loop."""
    path = np.asarray(path, np.float64)
    radii = np.broadcast_to(np.asarray(radius, np.float64), (len(path),))
    tangents = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0) if is_loop else np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=-1, keepdims=True)
    sides = _carried_frame(tangents, is_loop=is_loop)
    ups = np.cross(tangents, sides)
    angles = np.arange(segments) * (2 * np.pi / segments)
    around = np.cos(angles)[None, :, None] * sides[:, None] + np.sin(angles)[None, :, None] * ups[:, None]
    rings = path[:, None] + radii[:, None, None] * around
    indices = np.arange(len(path) * segments).reshape(len(path), segments)
    following = np.roll(indices, -1, axis=0) if is_loop else indices[1:]
    faces = [_band(low, high) for low, high in zip(indices, following)]
    positions = rings.reshape(-1, 3)
    if not is_loop:
        first, last = len(positions), len(positions) + 1
        positions = np.concatenate([positions, path[[0, -1]]])
        faces += [_band(np.full(segments, first), indices[0]), _band(indices[-1], np.full(segments, last))]
    return shaded(positions, np.concatenate(faces), crease_deg=60)


# Sheets: open surfaces that are seen from both sides


def sheet(corner: Point, edge_u: Point, edge_v: Point, *, cells: tuple[int, int] = (1, 1)) -> Mesh:
    """A flat parallelogram; its front is on the side of edge_u x edge_v."""
    u, v = (np.linspace(0, 1, count + 1) for count in cells)
    positions = np.asarray(corner) + u[:, None, None] * np.asarray(edge_u) + v[None, :, None] * np.asarray(edge_v)
    normal = np.cross(edge_u, edge_v)
    positions = positions.reshape(-1, 3)
    normals = np.broadcast_to(normal / np.linalg.norm(normal), positions.shape)
    return mesh_from(positions, grid_faces(cells[0] + 1, cells[1] + 1), normals)


def leaf(length: float, width: float, *, droop: float, fold: float = 0.25, rows: int = 5) -> Mesh:
    """A blade that grows from the origin along +x, folded along its midrib and bent down by `droop` radians.

    Args:
        fold: height of the rims above the midrib, in half widths.
        rows: parts along the midrib; the leaf has 4 (rows - 1) triangles.
    """
    t = np.linspace(0, 1, rows + 1)
    angle = -droop * t
    step = length / rows
    x = np.concatenate([[0], np.cumsum(step * np.cos((angle[1:] + angle[:-1]) / 2))])
    z = np.concatenate([[0], np.cumsum(step * np.sin((angle[1:] + angle[:-1]) / 2))])
    half = 0.5 * width * np.sin(np.pi * t**0.8) ** 0.9
    middle = np.stack([x, np.zeros_like(x), z], axis=-1)
    up = np.stack([-np.sin(angle), np.zeros_like(x), np.cos(angle)], axis=-1)
    sides = [
        middle[1:-1] + half[1:-1, None] * (side * np.array([0.0, 1.0, 0.0]) + fold * up[1:-1]) for side in (-1.0, 1.0)
    ]
    positions = np.concatenate([middle, *sides])
    inner = np.arange(1, rows)
    right, left = rows + inner, 2 * rows - 1 + inner
    faces = [(0, right[0], 1), (0, 1, left[0])]
    for i in range(rows - 2):
        m, n = inner[i], inner[i + 1]
        faces += [(m, right[i], right[i + 1]), (m, right[i + 1], n), (m, n, left[i + 1]), (m, left[i + 1], left[i])]
    faces += [(inner[-1], right[-1], rows), (inner[-1], rows, left[-1])]
    return shaded(positions, np.array(faces), crease_deg=75)


# Outlines

ARC_STEP = 0.0015
"""Metres along an arc from point to point, at most; more `segments` make it less."""


def filleted(corners: Sequence[tuple[float, float, float]], *, segments: int = 4) -> list[tuple[float, float]]:
    """An open outline through corners (radius, z, fillet radius), rounded by arcs except at its ends."""
    outline = [(float(corners[0][0]), float(corners[0][1]))]
    for before, (r, z, fillet), after in zip(corners, corners[1:], corners[2:]):
        corner = np.array([r, z], np.float64)
        back, forth = np.array(before[:2]) - corner, np.array(after[:2]) - corner
        room = 0.499 * min(np.linalg.norm(back), np.linalg.norm(forth))
        back, forth = back / np.linalg.norm(back), forth / np.linalg.norm(forth)
        half = np.arccos(np.clip(back @ forth, -1, 1)) / 2
        if fillet <= 0 or half > 0.49 * np.pi:
            outline.append((float(r), float(z)))
            continue
        reach = min(fillet / np.tan(half), room)
        centre = corner + (back + forth) / np.linalg.norm(back + forth) * (reach / np.cos(half))
        start, end = corner + reach * back - centre, corner + reach * forth - centre
        total = np.arctan2(start[0] * end[1] - start[1] * end[0], start @ end)
        steps = max(segments, int(np.ceil(abs(total) * float(np.linalg.norm(start)) / ARC_STEP)))
        for angle in np.linspace(0, total, steps + 1):
            cos, sin = np.cos(angle), np.sin(angle)
            outline.append(
                (float(centre[0] + cos * start[0] - sin * start[1]), float(centre[1] + sin * start[0] + cos * start[1]))
            )
    outline.append((float(corners[-1][0]), float(corners[-1][1])))
    return outline


def curved(points: Sequence[tuple[float, ...]], *, count: int) -> np.ndarray:
    """`count` points along a smooth curve (centripetal in spirit: cubic over chord length) through `points`."""
    from scipy.interpolate import CubicSpline

    through = np.asarray(points, np.float64)
    chords = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(through, axis=0), axis=-1) ** 0.5)])
    return CubicSpline(chords, through, axis=0)(np.linspace(0, chords[-1], count))


def walled(outer: Profile, *, wall: float, floor: float) -> list[tuple[float, float]]:
    """The outline of a vessel: `outer` from the axis up to the rim, a round rim, and back inside at `wall` metres.

    Args:
        floor: height of the lowest inner point above the lowest outer point.
    """
    line = np.asarray(outer, np.float64)
    tangents = np.gradient(line, axis=0)
    tangents /= np.linalg.norm(tangents, axis=-1, keepdims=True)
    inward = np.stack([-tangents[:, 1], tangents[:, 0]], axis=-1)
    inner = line + wall * inward
    bottom = float(line[:, 1].min() + floor)
    below = int(np.flatnonzero(inner[:, 1] <= bottom)[-1])
    share = (bottom - inner[below, 1]) / (inner[below + 1, 1] - inner[below, 1])
    corner = inner[below] + share * (inner[below + 1] - inner[below])
    inner = inner[:below:-1]
    middle, arm = (line[-1] + inner[0]) / 2, (line[-1] - inner[0]) / 2
    up = np.array([-arm[1], arm[0]])
    up = up if up @ tangents[-1] > 0 else -up
    rim = [middle + np.cos(a) * arm + np.sin(a) * up for a in np.linspace(0, np.pi, 7)[1:-1]]
    round_corner = filleted([(*_pair(inner[-1]), 0.0), (*_pair(corner), 0.6 * float(corner[0])), (0.0, bottom, 0.0)])
    return [*map(_pair, line), *map(_pair, rim), *map(_pair, inner[:-1]), *round_corner]


def filled(outer: Profile, *, wall: float, floor: float, level: float, reach: float) -> list[tuple[float, float]]:
    """The outline of a drink in the vessel `walled(outer, wall=wall, floor=floor)`, with a flat top.

    Args:
        level: height of the drink's top, in the heights of `outer`.
        reach: how far the drink extends into the wall and the floor; give its material the lower priority.
    """
    assert 0 < reach < min(wall, floor), f"reach {reach} of a wall of {wall} and a floor of {floor}"
    vessel = np.array(walled(outer, wall=wall - reach, floor=floor - reach))
    inner = vessel[vessel[:, 1].argmax() :]
    above = int(np.flatnonzero(inner[:, 1] > level)[-1])
    assert above + 1 < len(inner), f"level {level} is below the floor"
    share = (inner[above, 1] - level) / (inner[above, 1] - inner[above + 1, 1])
    edge = inner[above] + share * (inner[above + 1] - inner[above])
    return [(0.0, level), _pair(edge), *map(_pair, inner[above + 1 :])]


def knot(radius: float, swing: float, *, lobes: int = 3, count: int) -> Points:
    """A closed path for `tube`: twice around the z axis, swinging out, in, up and down by `swing` in each lobe."""
    loop = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ring = radius + swing * np.cos(lobes * loop)
    return np.stack([ring * np.cos(2 * loop), ring * np.sin(2 * loop), swing * np.sin(lobes * loop)], axis=-1)


def _pair(point: np.ndarray) -> tuple[float, float]:
    return float(point[0]), float(point[1])


# Assembling


def merged(parts: Sequence[Part]) -> Mesh:
    """All parts as one mesh."""
    fixed = [_transformed(part[0], np.eye(3), part[1]) if isinstance(part, tuple) else vars(part) for part in parts]
    offsets = np.cumsum([0, *(len(part["vertices"]) for part in fixed)])
    faces = [part["faces"] + offset for part, offset in zip(fixed, offsets)]
    joined = {name: np.concatenate([part[name] for part in fixed]) for name in ("vertices", "normals", "uv")}
    return Mesh(**joined, faces=np.concatenate(faces).astype(np.int32))


def moved(mesh: Mesh, offset: Sequence[float]) -> Mesh:
    """The mesh translated."""
    return transformed(mesh, np.eye(3), offset)


def resting(mesh: Mesh, place: Point) -> Mesh:
    """The mesh moved to (x, y), with its lowest point at height z."""
    x, y, height = place
    return moved(mesh, (x, y, height - float(mesh.vertices[:, 2].min())))


def turned(mesh: Mesh, axis: Point, angle_deg: float) -> Mesh:
    """The mesh rotated about an axis through the origin, anticlockwise as seen from the axis's tip."""
    return transformed(mesh, rotation(axis, angle_deg), (0, 0, 0))


def rotation(axis: Point, angle_deg: float) -> np.ndarray:
    """Rotation matrix (3, 3). Source: Rodrigues' formula."""
    x, y, z = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(angle_deg)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def transformed(mesh: Mesh, linear: np.ndarray, offset: Sequence[float]) -> Mesh:
    """The mesh under x -> linear x + offset; faces are flipped if `linear` mirrors, so that they stay outward."""
    return Mesh(**_transformed(mesh, linear, offset))


def _transformed(mesh: Mesh, linear: np.ndarray, offset: Sequence[float]) -> dict[str, np.ndarray]:
    normals = mesh.normals.astype(np.float64) @ np.linalg.inv(linear)
    faces = mesh.faces[:, ::-1] if np.linalg.det(linear) < 0 else mesh.faces
    vertices = mesh.vertices.astype(np.float64) @ np.asarray(linear).T + np.asarray(offset, np.float64)
    return {
        "vertices": vertices.astype(np.float32),
        "faces": np.ascontiguousarray(faces),
        "normals": (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32),
        "uv": mesh.uv,
    }


def deformed(mesh: Mesh, deform: Callable[[Points], Points], *, crease_deg: float = CREASE_DEG) -> Mesh:
    """The mesh with its points moved by a continuous function and new normals."""
    positions, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return shaded(deform(positions.astype(np.float64)), index.reshape(-1)[mesh.faces], crease_deg=crease_deg)


def shaded(positions: Points, faces: np.ndarray, *, crease_deg: float) -> Mesh:
    """A mesh of shared points with smooth normals; vertices are split where faces meet at more than the crease angle.

    Faces without area are removed.
    """
    assert np.isfinite(positions).all(), "a point is not finite"
    corners = positions[faces]
    faces = faces[np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1]), axis=-1) > 0]
    normals = corner_normals(positions, faces, crease_deg=crease_deg)
    at, first, index = split_corners(faces, normals)
    return mesh_from(positions[at], index, normals[first])


def convex_hull(points: Points, *, crease_deg: float) -> Mesh:
    """The convex hull of points, `shaded`."""
    import trimesh

    found = trimesh.convex.convex_hull(points)
    return shaded(np.asarray(found.vertices, np.float64), np.asarray(found.faces), crease_deg=crease_deg)


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Two triangles per cell of a (rows, columns) grid of points, facing along row direction x column direction."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.reshape(-1) for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])


def _band(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Triangles between two rings of point indices; a ring that is one point gives a fan."""
    next_low, next_high = np.roll(low, -1), np.roll(high, -1)
    faces = np.concatenate([np.stack([low, next_low, next_high], axis=-1), np.stack([low, next_high, high], axis=-1)])
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return faces[distinct]


def _carried_frame(tangents: np.ndarray, *, is_loop: bool) -> np.ndarray:
    """A unit normal per point, carried along the path without twist; a loop spreads the remaining twist evenly."""
    seed = np.eye(3)[np.abs(tangents[0]).argmin()]
    sides = [np.cross(tangents[0], seed)]
    for tangent in tangents[1:]:
        side = sides[-1] - tangent * (sides[-1] @ tangent)
        sides.append(side / np.linalg.norm(side))
    carried = np.array(sides) / np.linalg.norm(sides, axis=-1, keepdims=True)
    if not is_loop:
        return carried
    back = carried[-1] - tangents[0] * (carried[-1] @ tangents[0])
    twist = np.arctan2(np.cross(back, carried[0]) @ tangents[0], back @ carried[0])
    angles = np.linspace(0, 1, len(tangents), endpoint=False)[:, None] * twist
    return np.cos(angles) * carried + np.sin(angles) * np.cross(tangents, carried)
