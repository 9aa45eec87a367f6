"""Queries of meshes by points and lines, in float64 and without Mitsuba: near, inside, crossed; and checks of glass."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Float64, Int

from datagen.data.meshes import Mesh, SurfacePoints, component_of_faces, face_corners, normals_of, open_edges, points_on
from datagen.disk.errors import HyalineError

NUM_POINTS = 1024
"""Points on a surface that are checked for the outside on their outer side; spread by area."""
NUM_POINTS_A_PART = 16
"""Further points on each connected part, so that small parts are checked, too."""
MAX_SHARE_INSIDE = 0.005
"""Largest share of a surface that may lie inside the rest of it; good assets have 0."""

FLAT = 1e-9
"""Sine of the angle between a line and a face's plane below which the line counts as lying in it."""

_PAIRS_AT_ONCE = 1 << 20


def windings(
    corners: Float[np.ndarray, "face 3 3"],
    points: Float[np.ndarray, "point 3"],
    own: Int[np.ndarray, " point"] | None = None,
) -> Int[np.ndarray, " point"]:
    """The winding number of closed, outward triangles around each point: 1 inside a solid, 0 outside.

    It counts the faces that a ray from the point leaves through minus those that it enters through.

    Args:
        own: the face that each point lies on; its winding number is then that just outside this face.
    """
    rotation, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    turn = rotation * np.sign(np.linalg.det(rotation))
    corners, points = corners.astype(np.float64) @ turn.T, points.astype(np.float64) @ turn.T
    normals = normals_of(corners)
    counts = np.zeros(len(points), np.int64)
    low, high = corners[..., :2].min(axis=1), corners[..., :2].max(axis=1)
    for face, point in near_pairs(corners[..., :2], points[:, :2]):
        in_box = ((low[face] <= points[point, :2]) & (points[point, :2] <= high[face])).all(axis=-1)
        face, point = face[in_box], point[in_box]
        flat = corners[face, :, :2]
        edges = np.roll(flat, -1, axis=1) - flat
        to_point = points[point, None, :2] - flat
        side = edges[..., 0] * to_point[..., 1] - edges[..., 1] * to_point[..., 0]
        leaves, enters = np.all(side > 0, axis=-1), np.all(side < 0, axis=-1)
        crossed = leaves | enters
        if own is not None:
            crossed &= face != own[point]
        face, point, leaves = face[crossed], point[crossed], leaves[crossed]
        height = np.einsum("pc,pc->p", corners[face, 0] - points[point], normals[face]) / normals[face, 2]
        signs = np.where(height > 0, np.where(leaves, 1, -1), 0)
        counts += np.bincount(point, signs, minlength=len(points)).astype(np.int64)
    # A ray that starts on a face which looks the other way starts inside.
    return counts if own is None else counts - (normals[own, 2] < 0)


def near_pairs(
    corners: Float[np.ndarray, "face 3 axis"], points: Float[np.ndarray, "point axis"], margin: float = 0.0
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(face, point) of all points in the bounding circle or ball of a face, or at most `margin` beside, in pieces."""
    from scipy.spatial import KDTree

    middle = (corners.max(axis=1) + corners.min(axis=1)) / 2
    radius = np.linalg.norm(corners - middle[:, None], axis=-1).max(axis=1) + margin
    tree = KDTree(points)
    counts = np.asarray(tree.query_ball_point(middle, radius, return_length=True))
    met = np.flatnonzero(counts)
    for piece in np.array_split(met, max(1, int(counts.sum()) // _PAIRS_AT_ONCE)):
        if len(piece):
            found = tree.query_ball_point(middle[piece], radius[piece])
            yield np.repeat(piece, counts[piece]), np.concatenate([np.asarray(p, np.int64) for p in found])


def nearest_points(
    points: Float64[np.ndarray, "point 3"], corners: Float64[np.ndarray, "face 3 3"]
) -> tuple[Float64[np.ndarray, " point"], SurfacePoints]:
    """The distance of each point from some triangles, and the exact nearest point on them."""
    from scipy.spatial import KDTree
    from trimesh.triangles import closest_point

    # A triangle is never farther than its nearest corner; only triangles whose bounding ball is closer are tested.
    best, corner = map(np.asarray, KDTree(corners.reshape(-1, 3)).query(points))
    best_face, best_position = corner // 3, corners.reshape(-1, 3)[corner]
    centers = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centers[:, None], axis=-1).max(axis=1)
    # One tree per triangle size; otherwise one large triangle would make every search large.
    sizes = np.floor(np.log2(np.maximum(radii, 1e-30))).astype(int)
    for size in np.unique(sizes)[::-1]:
        index = np.flatnonzero(sizes == size)
        tree, reach = KDTree(centers[index]), radii[index].max()
        for start in range(0, len(points), 512):
            rows = np.arange(start, min(start + 512, len(points)))
            near = tree.query_ball_point(points[rows], best[rows] + reach)
            row = np.repeat(rows, [len(found) for found in near])
            face = index[np.concatenate([np.asarray(found, np.int64) for found in near])]
            if len(row):
                position = closest_point(corners[face], points[row])
                distance = np.linalg.norm(position - points[row], axis=-1)
                order = np.lexsort((distance, row))
                first = order[np.unique(row[order], return_index=True)[1]]
                first = first[distance[first] < best[row[first]]]
                best[row[first]], best_face[row[first]] = distance[first], face[first]
                best_position[row[first]] = position[first]
    return best, SurfacePoints(face=best_face, position=best_position)


def crossings(
    corners: Float[np.ndarray, "face 3 3"],
    origins: Float[np.ndarray, "line 3"],
    directions: Float[np.ndarray, "line 3"],
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(line, face, distance) where lines pass through triangles, in pieces; a line through an edge meets its faces.

    All three edges lie on one side of the line, by Plücker coordinates. Distances are in lengths of the direction and
    negative behind the origin. Lines in a face's plane do not meet it.
    """
    middle = corners.mean(axis=(0, 1), dtype=np.float64) if len(corners) else np.zeros(3)
    corners, origins, normals = corners - middle, origins - middle, normals_of(corners)
    following = np.roll(corners, -1, axis=1)
    edges = np.concatenate([np.cross(corners, following), following - corners], axis=-1)
    lines = np.concatenate([directions, np.cross(origins, directions)], axis=-1)
    length, size = np.linalg.norm(directions, axis=-1), np.linalg.norm(normals, axis=-1)
    step = max(1, _PAIRS_AT_ONCE // max(1, len(corners)))
    for start in range(0, len(lines), step):
        sides = [lines[start : start + step] @ edges[:, edge].T for edge in range(3)]
        line, face = np.nonzero((np.minimum.reduce(sides) >= 0) | (np.maximum.reduce(sides) <= 0))
        line += start
        slope = np.einsum("pc,pc->p", directions[line], normals[face])
        is_steep = np.abs(slope) > FLAT * length[line] * size[face]
        line, face = line[is_steep], face[is_steep]
        yield line, face, np.einsum("pc,pc->p", corners[face, 0] - origins[line], normals[face]) / slope[is_steep]


# Checks of glass


def parts_inside_out(mesh: Mesh) -> tuple[Int[np.ndarray, " face"], Float[np.ndarray, " part"], list[int]]:
    """The part of each face of a closed mesh, the parts' signed volumes, and which are inside out: not cavities."""
    corners, part = face_corners(mesh).astype(np.float64), component_of_faces(mesh)
    a, b, c = np.moveaxis(corners - corners.mean(axis=(0, 1)), 1, 0)
    volumes = np.bincount(part, np.einsum("fi,fi->f", a, np.cross(b, c)) / 6)
    if not len(hollow := np.flatnonzero(volumes <= 0)):
        return part, volumes, []
    # On the outer side of a cavity's faces is air that the rest of the mesh has gone around: 1 - 1 = 0.
    face = np.unique(part, return_index=True)[1][hollow]
    return part, volumes, hollow[windings(corners, corners[face].mean(axis=1), face) < 0].tolist()


def check_closed(mesh: Mesh, *, where: str) -> None:
    """Raises for a mesh that cannot bound a medium: glass must be closed, and each connected part wound outward.

    A part that is wound inward is a cavity, which is allowed if the rest of the mesh encloses it.
    """
    if count := open_edges(mesh):
        raise HyalineError(f"{where}: {count} open edges; glass must be a closed mesh, fill its holes")
    _, volumes, inside_out = parts_inside_out(mesh)
    for index in inside_out[:1]:
        which = f"part {index + 1} of {len(volumes)} " if len(volumes) > 1 else ""
        raise HyalineError(f"{where}: {which}encloses {volumes[index]:g} m^3, so it is inside out; reverse its faces")


def check_solid(mesh: Mesh, *, where: str) -> None:
    """Raises for closed glass that bounds no solid: overlapping parts, a part inside another, a surface that crosses
    itself.

    A closed part inside another is a cavity, which is allowed if it is wound inward.
    """
    corners, part = face_corners(mesh).astype(np.float64), component_of_faces(mesh)
    found = points_on(mesh, NUM_POINTS, part=part, count_a_part=NUM_POINTS_A_PART)
    face, points = found.face, found.position
    around = windings(corners, points, face)
    is_wrong = around != 0
    num_parts = int(part.max()) + 1
    of_part = np.bincount(part[face], is_wrong, minlength=num_parts) / np.bincount(part[face], minlength=num_parts)
    share = float(is_wrong[:NUM_POINTS].mean())
    if share <= MAX_SHARE_INSIDE and of_part.max() <= 0.5:
        return
    worst = int(of_part.argmax())
    mine = part[face] == worst
    if num_parts > 1 and (around[mine] > 0).all():
        raise HyalineError(
            f"{where}: part {worst + 1} of {num_parts} lies inside another part and is wound outward; delete it, "
            "reverse its faces if it is a bubble, or make it an object of its own"
        )
    place = ", ".join(f"{value:.3g}" for value in np.median(points[is_wrong], axis=0))
    what = "its parts overlap" if num_parts > 1 else "the surface crosses itself"
    raise HyalineError(
        f"{where}: {100 * share:.1f} % of the surface, around ({place}), lies inside of the rest: {what}; "
        "unite it to one solid (a boolean union), or make objects of its parts, each with a priority"
    )
