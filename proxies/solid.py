"""Solids, which every kind of proxy is fitted to; surfaces, which are unwrapped; and the quality of a proxy.

A solid is an object's points with a volume and a convex hull; a surface a closed mesh that has no uv yet.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from datagen.data.geometries import ProxyStatistics
from datagen.data.meshes import (
    Mesh,
    component_of_faces,
    face_corners,
    mesh_from,
    normals_of,
    open_edges,
    points_on,
    signed_volume,
)
from datagen.data.queries import crossings, nearest_points, windings
from datagen.scene.atlas import coverage, unwrap_all

MIN_THICKNESS = 1e-3
"""Flat objects (a floor, a pane, a leaf) are thickened to this part of their extent, at most to this many metres."""

MIN_RELATIVE_TO_COORDINATES = 1e-4
"""Yet never thinner than this part of the largest coordinate: float32 steps (1e-7 of it) must stay far smaller."""

ATLAS_ROOM = 1.5e-6
"""Least area of a face in uv, relative to the atlas: a tenth of a texel at 256^2."""

COVERAGE_SIZE = 512
"""Texels a side of the atlas in which a chart must not fold over itself."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """The points that a proxy must enclose; flat objects come thickened, so that every solid has a volume."""

    mesh: Mesh
    """The object itself, not thickened; open or closed, in parts or one."""
    points: Float64[np.ndarray, "point 3"]
    """Positions in metres without repeats; the object's vertices lie among or between them."""
    hull_points: Float64[np.ndarray, "vertex 3"]
    """Those of the points that span the convex hull."""
    hull_faces: Int64[np.ndarray, "face 3"]
    """Triangles on `hull_points`, outward."""

    @property
    def thickness(self) -> float:
        """Extent in metres along the principal direction of the points in which they spread least."""
        return float(np.ptp(self.hull_points @ principal_directions(self.hull_points)[-1]))

    @property
    def hull_volume(self) -> float:
        """Volume of the convex hull in cubic metres."""
        a, b, c = np.moveaxis(self.hull_points[self.hull_faces] - self.points.mean(axis=0), 1, 0)
        return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def make_solid(mesh: Mesh) -> Solid:
    """The solid of a mesh, whose arrays must be valid (`datagen.data.meshes.check_mesh`)."""
    points = thickened(used_positions(mesh))
    low, high = points.min(axis=0), points.max(axis=0)
    # In a unit box around the origin: Qhull's tolerances are absolute.
    used, faces = convex_hull((points - 0.5 * (low + high)) / (high - low).max())
    return Solid(mesh=mesh, points=points, hull_points=points[used], hull_faces=faces)


def used_positions(mesh: Mesh) -> Float64[np.ndarray, "point 3"]:
    """Positions of a mesh's vertices that belong to a face, without repeats."""
    return np.unique(mesh.vertices[np.unique(mesh.faces)], axis=0).astype(np.float64)


def thickened(points: Float64[np.ndarray, "point 3"]) -> Float64[np.ndarray, "_ 3"]:
    """The points, doubled to both sides of wherever they are thinner than the minimal thickness.

    Directions are the principal ones; a point lies midway between its two copies, so inside their hull.
    """
    extent = np.ptp(points, axis=0).max()
    thickness = max(min(MIN_THICKNESS, MIN_THICKNESS * extent), MIN_RELATIVE_TO_COORDINATES * np.abs(points).max())
    for direction in principal_directions(points):
        missing = thickness - np.ptp(points @ direction)
        if missing > 0:
            step = 0.5 * missing * direction
            points = np.concatenate([points - step, points + step])
    return points


def principal_directions(points: Float64[np.ndarray, "point 3"]) -> Float64[np.ndarray, "3 3"]:
    """Unit directions as rows, the one along which three or more points spread most first."""
    return np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]


def outside_by(corners: Float64[np.ndarray, "face 3 3"], points: Float64[np.ndarray, "point 3"]) -> np.ndarray:
    """How far each point (point,) lies outside the convex polyhedron of outward triangles; negative inside. Metres."""
    normals = normals_of(corners)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    offsets = np.einsum("fi,fi->f", normals, corners[:, 0])
    largest = np.full(len(points), -np.inf)
    for start in range(0, len(normals), 256):
        part = slice(start, start + 256)
        np.maximum(largest, (points @ normals[part].T - offsets[part]).max(axis=1), out=largest)
    return largest


def planes_of(corners: Float64[np.ndarray, "face 3 3"]) -> Float64[np.ndarray, "face 3"]:
    """The planes of triangles that miss the origin, each as the n of n x = 1."""
    planes = normals_of(corners)
    return planes / np.einsum("fi,fi->f", planes, corners[:, 0])[:, None]


def gauge(planes: Float64[np.ndarray, "face 3"], points: Float64[np.ndarray, "point 3"]) -> float:
    """The scale about the origin at which a convex polyhedron around the origin encloses all points."""
    return max(float((points @ planes[start : start + 256].T).max()) for start in range(0, len(planes), 256))


def convex_hull(
    points: Float64[np.ndarray, "point 3"],
) -> tuple[Int64[np.ndarray, " vertex"], Int64[np.ndarray, "face 3"]]:
    """Which points span the convex hull (sorted), and the hull's outward faces on those."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    # Qhull winds its triangles at random; its plane equations know what is outside.
    is_inward = np.einsum("fi,fi->f", normals_of(points[hull.simplices]), hull.equations[:, :3]) < 0
    faces = np.where(is_inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, compact = np.unique(faces, return_inverse=True)
    return used.astype(np.int64), compact.reshape(faces.shape).astype(np.int64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """A mesh before it is unwrapped."""

    vertices: Float64[np.ndarray, "vertex 3"]
    """Positions in metres; one that has several normals stands several times."""
    faces: Int64[np.ndarray, "face 3"]
    """Outward."""
    normals: Float64[np.ndarray, "vertex 3"]
    """Unit shading normals."""
    charted: Float64[np.ndarray, "vertex 3"]
    """The vertices in the space, any affine image of the world, whose areas the atlas keeps in proportion: where the
    object is thin, thin faces get texels in a space that makes it thicker."""


def unwrap_surfaces(surfaces: tuple[Surface, ...]) -> tuple[Mesh, ...]:
    """Each surface with a uv of its own for every point; vertices stand several times along the atlas's seams."""
    charted = unwrap_all(
        {
            f"proxy {index + 1} of {len(surfaces)}": mesh_from(surface.charted, surface.faces, surface.normals)
            for index, surface in enumerate(surfaces)
        }
    )
    return tuple(_laid_on(surface, mesh) for surface, mesh in zip(surfaces, charted.values(), strict=True))


def unwrap_sound(propose: Callable[[int, int], Surface], *, count: int, places: int) -> tuple[Mesh, ...]:
    """For each of `count` objects the first surface that xatlas lays out with texels for every face and without folds.

    xatlas 0.0.11 may fold a chart of large triangles, and squeeze small ones at sharp edges. Where no surface is laid
    out well, the first stands, and its check says what is wrong with it.

    Args:
        propose: the surface of an object at a place, from 0 to `places` - 1.
    """
    meshes: dict[int, Mesh] = {}
    unsound = list(range(count))
    for place in range(places):
        unwrapped = unwrap_surfaces(tuple(propose(index, place) for index in unsound))
        tried, unsound = unsound, []
        for index, mesh in zip(tried, unwrapped, strict=True):
            is_sound = smallest_chart(mesh) >= ATLAS_ROOM and coverage(mesh, COVERAGE_SIZE).max() <= 1
            if is_sound or index not in meshes:
                meshes[index] = mesh
            if not is_sound:
                unsound.append(index)
    return tuple(meshes[index] for index in range(count))


def _laid_on(surface: Surface, charted: Mesh) -> Mesh:
    """The surface with the atlas of its charted twin, whose faces are the same in the same order."""
    vertex_of = np.zeros(len(charted.vertices), np.int64)
    vertex_of[charted.faces] = surface.faces
    return mesh_from(surface.vertices[vertex_of], charted.faces, surface.normals[vertex_of], charted.uv)


def smallest_chart(mesh: Mesh) -> float:
    """Least area of a face in uv; charts may be mirrored, because xatlas 0.0.11 rotates them by swapping u and v."""
    a, b, c = np.moveaxis(mesh.uv[mesh.faces].astype(np.float64), 1, 0)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    return float((0.5 * np.abs(ux * vy - uy * vx)).min())


# The quality of a proxy: whether it encloses its object, their volumes, and the distance of their surfaces.
#
# Enclosure is tested for vertices, edges and faces, without sampling: if no edge of either surface crosses a face of
# the other, each connected part of one lies completely inside or outside the other, and one point decides which.


SAMPLES = 4096
"""Points on a proxy, besides its vertices, for which distances are measured."""

ROUNDING = 32 * 2.0**-24
"""Largest distance of a facet with float32 vertices from its plane, relative to the largest coordinate."""

TOUCH = 1e-9
"""Share of an edge's length up to which it touches what it does not reach."""

EDGES_AT_ONCE = 512


@dataclass(frozen=True, kw_only=True)
class Enclosure:
    """Whether a proxy is sound."""

    inside_share: float
    """Share of the object's vertices for a convex proxy, otherwise of the object's faces."""
    problem: str | None
    """The problem in a few words; None if the proxy is sound."""


def enclosure(proxy: Mesh, truth: Mesh | None) -> Enclosure:
    """Checks a proxy as it is stored, in float32, against its object.

    Args:
        truth: None for a fitted surface, which need not enclose anything, and whose roundings may be finer than texels.
    """
    inside_share = 1.0 if truth is None else _inside_share(proxy, truth)
    chart = 1.0 if truth is None else smallest_chart(proxy)
    problem = None
    if count := open_edges(proxy):
        problem = f"has {count} open edges"
    elif (volume := signed_volume(proxy)) <= 0:
        problem = f"encloses {volume:g} m^3, it is inside out"
    elif inside_share < 1:
        problem = f"leaves {100 * (1 - inside_share):.3g} % of the object outside"
    elif chart < ATLAS_ROOM:
        problem = f"has a face of {chart:g} of the atlas"
    return Enclosure(inside_share=inside_share, problem=problem)


def proxy_statistics(mesh: Mesh, truth: Mesh, solid: Solid) -> ProxyStatistics:
    """The numbers of a proxy; a flat object counts with the minimal thickness, so that ratios are finite."""
    # Digits beyond float32's are meaningless.
    ratio = float(f"{signed_volume(mesh) / solid.hull_volume:.6g}")
    if mesh is truth:
        return ProxyStatistics(volume_ratio=ratio, mean_distance=0.0, max_distance=0.0)
    points = np.concatenate([points_on(mesh, SAMPLES).position, mesh.vertices.astype(np.float64)])
    distances, _ = nearest_points(points, face_corners(truth).astype(np.float64))
    mean, farthest = (float(f"{value:.6g}") for value in (distances[:SAMPLES].mean(), distances.max()))
    return ProxyStatistics(volume_ratio=ratio, mean_distance=mean, max_distance=farthest)


def _inside_share(proxy: Mesh, truth: Mesh) -> float:
    positions, corners = used_positions(truth), face_corners(proxy).astype(np.float64)
    tolerance = ROUNDING * max(np.abs(positions).max(), np.abs(proxy.vertices).max())
    # Planes are exact for a convex proxy, with a tolerance for rounding.
    if outside_by(corners, corners.reshape(-1, 3)).max() <= tolerance:
        return float((outside_by(corners, positions) <= tolerance).mean())
    return enclosed_share(proxy, truth)


def enclosed_share(proxy: Mesh, truth: Mesh) -> float:
    """Share of the object's faces that are completely inside the proxy; 1 only if it encloses the whole object."""
    corners = face_corners(truth).astype(np.float64)
    is_inside = ~crossed_faces(proxy, truth)
    component = component_of_faces(truth)
    around = face_corners(proxy).astype(np.float64)
    for part in np.unique(component):
        mine = np.flatnonzero((component == part) & is_inside)
        if len(mine) and windings(around, corners[mine[:1], 0])[0] < 1:
            is_inside[mine] = False
    return float(is_inside.mean())


def crossed_faces(proxy: Mesh, truth: Mesh) -> Bool[np.ndarray, " face"]:
    """Mask of the object's faces that intersect or touch the proxy's surface."""
    ours, around = (face_corners(mesh).astype(np.float64) for mesh in (truth, proxy))
    crossed = np.zeros(len(ours), bool)
    for edge, _ in _crossings(_edges(ours), around):
        crossed[edge // 3] = True
    for _, face in _crossings(_edges(around), ours):
        crossed[face] = True
    return crossed


def _edges(corners: Float64[np.ndarray, "face 3 3"]) -> Float64[np.ndarray, "edge 2 3"]:
    """Both ends of each face's three edges."""
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)


def _crossings(
    edges: Float64[np.ndarray, "edge 2 3"], corners: Float64[np.ndarray, "face 3 3"]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs (edge, face), in pieces, where the edge intersects or touches the face.

    Edges in a face's plane are undecidable, and not needed: other edges meet where they do.
    """
    low, high = edges.min(axis=1), edges.max(axis=1)
    face_low, face_high = corners.min(axis=1), corners.max(axis=1)
    order = np.argsort(low[:, int(np.ptp(low, axis=0).argmax())])
    for start in range(0, len(order), EDGES_AT_ONCE):
        part = order[start : start + EDGES_AT_ONCE]
        is_near = (face_low <= high[part].max(axis=0)) & (face_high >= low[part].min(axis=0))
        near = np.flatnonzero(is_near.all(axis=1))
        for edge, face, share in crossings(corners[near], edges[part, 0], edges[part, 1] - edges[part, 0]):
            within = np.abs(share - 0.5) <= 0.5 + TOUCH
            yield part[edge[within]], near[face[within]]
