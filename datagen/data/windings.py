"""How often a surface winds around a point: what tells the inside of a solid from its outside.

Each point looks along one ray, in a direction that no model is aligned with, and counts the faces that it leaves
through minus those that it enters through. Exact but for points within rounding of an edge.
"""

import numpy as np
from jaxtyping import Float, Int

from datagen.data.meshes import Mesh, component_of_faces, face_corners, open_edges
from datagen.data.surface_points import points_on
from datagen.disk.errors import HyalineError

SAMPLES = 1024
"""Points on a surface of which each must have the outside on its outer side; spread by area."""
SAMPLES_A_PART = 16
"""More of them on each connected part, so that none is too small to be looked at."""
MAX_SHARE = 0.005
"""Share of a surface that may lie inside of the rest of it. All good assets that were measured have 0."""

_POINTS_AT_ONCE = 1 << 20


def windings(
    corners: Float[np.ndarray, "face 3 3"],
    points: Float[np.ndarray, "point 3"],
    own: Int[np.ndarray, " point"] | None = None,
) -> Int[np.ndarray, " point"]:
    """How often closed, outward triangles go around each point: 1 inside of a solid, 0 outside.

    Args:
        own: the face that each point lies on; its winding number is then that just outside of this face.
    """
    turn = _generic_rotation()
    corners, points = corners.astype(np.float64) @ turn.T, points.astype(np.float64) @ turn.T
    pairs = _pairs_of_ray_and_face(corners[..., :2], points[:, :2])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    counts = np.zeros(len(points), np.int64)
    low, high = corners[..., :2].min(axis=1), corners[..., :2].max(axis=1)
    for face, point in pairs:
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


def check_closed(mesh: Mesh, *, where: str) -> None:
    """Refuses what cannot bound a medium: glass must be closed, and outward in each connected part.

    A part that is wound inward is a cavity, and allowed, where the rest of the mesh encloses it.

    Raises:
        HyalineError: an open edge, or a part of the mesh is inside out.
    """
    if count := open_edges(mesh):
        raise HyalineError(f"{where}: {count} open edges; glass must be a closed mesh, fill its holes")
    corners, part = face_corners(mesh).astype(np.float64), component_of_faces(mesh)
    a, b, c = np.moveaxis(corners - corners.mean(axis=(0, 1)), 1, 0)
    volumes = np.bincount(part, np.einsum("fi,fi->f", a, np.cross(b, c)) / 6)
    hollow = np.flatnonzero(volumes <= 0)
    if not len(hollow):
        return
    # On the outer side of a cavity's faces is air that the rest of the mesh has gone around: 1 - 1 = 0.
    face = np.unique(part, return_index=True)[1][hollow]
    for index in hollow[windings(corners, corners[face].mean(axis=1), face) < 0][:1]:
        which = f"part {index + 1} of {len(volumes)} " if len(volumes) > 1 else ""
        raise HyalineError(f"{where}: {which}encloses {volumes[index]:g} m^3, so it is inside out; reverse its faces")


def check_solid(mesh: Mesh, *, where: str) -> None:
    """Refuses closed glass that no solid is bounded by: parts that overlap, a part inside another, a crossed surface.

    A closed part that another encloses is a cavity and allowed where it is wound inward.

    Raises:
        HyalineError: some of the surface has no outside on its outer side.
    """
    corners, part = face_corners(mesh).astype(np.float64), component_of_faces(mesh)
    found = points_on(mesh, SAMPLES, part=part, count_a_part=SAMPLES_A_PART)
    face, points = found.face, found.position
    around = windings(corners, points, face)
    is_wrong = around != 0
    num_parts = int(part.max()) + 1
    of_part = np.bincount(part[face], is_wrong, minlength=num_parts) / np.bincount(part[face], minlength=num_parts)
    share = float(is_wrong[:SAMPLES].mean())
    if share <= MAX_SHARE and of_part.max() <= 0.5:
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


def _generic_rotation() -> Float[np.ndarray, "3 3"]:
    rotation, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    return rotation * np.sign(np.linalg.det(rotation))


def _pairs_of_ray_and_face(
    flat: Float[np.ndarray, "face 3 2"], rays: Float[np.ndarray, "point 2"]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(face, point) of all rays through the circle around a face's shadow, in pieces."""
    from scipy.spatial import KDTree

    middle = (flat.max(axis=1) + flat.min(axis=1)) / 2
    radius = np.linalg.norm(flat - middle[:, None], axis=-1).max(axis=1)
    tree = KDTree(rays)
    counts = np.asarray(tree.query_ball_point(middle, radius, return_length=True))
    met = np.flatnonzero(counts)
    pairs = []
    for piece in np.array_split(met, max(1, int(counts.sum()) // _POINTS_AT_ONCE)):
        if len(piece):
            found = tree.query_ball_point(middle[piece], radius[piece])
            pairs.append((np.repeat(piece, counts[piece]), np.concatenate([np.asarray(p, np.int64) for p in found])))
    return pairs
