"""Triangle meshes: the record, its measures, points on its surface, and checks."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int, Int32, Integer

from datagen.disk.errors import HyalineError

MAX_EXTENT = 1e5
"""Largest coordinate in metres; farther out, float32 rays lose millimetres."""

MIN_AREA = 1e-14
"""Square metres; a smaller face (0.1 micrometres a side) counts as degenerate."""


FOLDED = 1e-6
"""Share of a polygon's area that a triangle of its fan may cover the wrong way round: more is no rounding."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """A triangle mesh in world space with one normal and one uv per vertex.

    Vertices are split where the normal or the atlas has a seam, so positions may repeat.
    Winding is counter-clockwise seen from outside.
    """

    vertices: Float32[np.ndarray, "vertex 3"]
    """Positions in metres, +z up."""
    faces: Int32[np.ndarray, "face 3"]
    """Vertex indices."""
    normals: Float32[np.ndarray, "vertex 3"]
    """Unit shading normals, outward."""
    uv: Float32[np.ndarray, "vertex 2"]
    """Atlas coordinates in [0, 1]; every surface point has its own texels. v points up in the image."""


def mesh_from(
    positions: Float[np.ndarray, "vertex 3"],
    faces: Integer[np.ndarray, "face 3"],
    normals: Float[np.ndarray, "vertex 3"] | None = None,
    uv: Float[np.ndarray, "vertex 2"] | None = None,
) -> Mesh:
    """The mesh of arrays of any precision; by default its normals are smooth and its uv are 0."""
    normals = vertex_normals(positions, faces) if normals is None else normals
    uv = np.zeros((len(positions), 2)) if uv is None else uv
    vertices, normals, uv = (np.ascontiguousarray(values, np.float32) for values in (positions, normals, uv))
    return Mesh(vertices=vertices, faces=np.ascontiguousarray(faces, np.int32), normals=normals, uv=uv)


def no_mesh() -> Mesh:
    """A mesh without faces: that of an object removed from its scene, whose id stays unused."""
    return mesh_from(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)))


def is_there(mesh: Mesh) -> bool:
    """False for the mesh of a removed object."""
    return len(mesh.faces) > 0


def face_corners(mesh: Mesh) -> Float32[np.ndarray, "face 3 3"]:
    return mesh.vertices[mesh.faces]


def normals_of(corners: Float[np.ndarray, "face 3 3"]) -> Float64[np.ndarray, "face 3"]:
    """Outward normals of triangles, each as long as twice the area."""
    a, b, c = np.moveaxis(corners.astype(np.float64), 1, 0)
    return np.cross(b - a, c - a)


def face_areas(mesh: Mesh) -> np.ndarray:
    """Areas in square metres, one a face, in float64."""
    return 0.5 * np.linalg.norm(normals_of(face_corners(mesh)), axis=-1)


def welded(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Positions without repeats (p, 3) and the faces on them (face, 3): the surface without its seams."""
    positions, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return positions, index.reshape(-1)[mesh.faces]


def signed_volume(mesh: Mesh) -> float:
    """Enclosed volume in cubic metres by the divergence theorem; negative when the mesh is inside out."""
    return volume_within(face_corners(mesh))


def volume_within(corners: Float[np.ndarray, "face 3 3"]) -> float:
    """`signed_volume` of faces by their corners."""
    centered = corners.astype(np.float64) - corners.mean(axis=(0, 1), dtype=np.float64)
    a, b, c = np.moveaxis(centered, 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def component_of_faces(mesh: Mesh) -> np.ndarray:
    """The connected component of each face (face,) on the welded surface, counted from 0."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    positions, faces = welded(mesh)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(len(positions),) * 2)
    _, component = connected_components(graph, directed=False)
    _, component = np.unique(component[faces[:, 0]], return_inverse=True)
    return component


def open_edges(mesh: Mesh) -> int:
    """The number of edges that are not shared by exactly two oppositely wound faces; 0 for a closed mesh."""
    _, faces = welded(mesh)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    base = directed.max() + 1
    forward, counts = np.unique(directed[:, 0] * base + directed[:, 1], return_counts=True)
    backward = np.unique(directed[:, 1] * base + directed[:, 0])
    return int((counts != 1).sum() + len(np.setdiff1d(forward, backward, assume_unique=True)))


def boxes_meet(mesh: Mesh, other: Mesh, margin: float = 0.0) -> bool:
    """Whether the bounding boxes of two meshes overlap, or are at most `margin` apart."""
    (low, high), (other_low, other_high) = ((m.vertices.min(axis=0), m.vertices.max(axis=0)) for m in (mesh, other))
    return bool(((low <= other_high + margin) & (other_low <= high + margin)).all())


def count_shared_faces(mesh: Mesh, other: Mesh) -> int:
    """The number of faces whose corners are all vertices of the other mesh, too, bit by bit."""
    if not boxes_meet(mesh, other):
        return 0
    # Adding 0 makes -0 the same bits as 0.
    keys, others = (np.ascontiguousarray(m.vertices + np.float32(0)).view("V12").reshape(-1) for m in (mesh, other))
    return int(np.isin(keys, others)[mesh.faces].all(axis=-1).sum())


def check_mesh(mesh: Mesh, *, where: str) -> None:
    """Raises for a mesh that would crash a native library or be rendered silently wrong."""
    check_numbers(mesh, where=where)
    for name, values in (("normals", mesh.normals), ("uv", mesh.uv)):
        _check_finite(name, values, where=where)
    check_areas(mesh, where=where)
    if mesh.uv.min() < 0 or mesh.uv.max() > 1:
        raise HyalineError(f"{where}: uv spans {mesh.uv.min():g} to {mesh.uv.max():g}; expected [0, 1], unwrap it")


def check_numbers(mesh: Mesh, *, where: str) -> None:
    """Raises for an empty mesh, arrays that do not match, or coordinates that cannot be traced."""
    if len(mesh.vertices) == 0 or len(mesh.faces) == 0:
        raise HyalineError(
            f"{where}: has {len(mesh.vertices)} vertices and {len(mesh.faces)} faces; expected at least one of each"
        )
    for name, values in (("normals", mesh.normals), ("uv", mesh.uv)):
        if len(values) != len(mesh.vertices):
            raise HyalineError(f"{where}: {len(values)} {name} for {len(mesh.vertices)} vertices; expected one each")
    _check_finite("vertices", mesh.vertices, where=where)
    if np.abs(mesh.vertices).max() > MAX_EXTENT:
        raise HyalineError(
            f"{where}: a coordinate is {np.abs(mesh.vertices).max():g} m; expected at most {MAX_EXTENT:g}, rescale it"
        )
    low, high = int(mesh.faces.min()), int(mesh.faces.max())
    if low < 0 or high >= len(mesh.vertices):
        raise HyalineError(
            f"{where}: a face names vertex {low if low < 0 else high}; expected 0 to {len(mesh.vertices) - 1}"
        )


def check_areas(mesh: Mesh, *, where: str) -> None:
    """Raises for faces without area."""
    if (areas := face_areas(mesh)).min() < MIN_AREA:
        raise HyalineError(f"{where}: face {int(areas.argmin())} has no area; remove degenerate faces")


def _check_finite(name: str, values: np.ndarray, *, where: str) -> None:
    if not np.isfinite(values).all():
        index = int(np.argwhere(~np.isfinite(values))[0, 0])
        raise HyalineError(f"{where}: {name}[{index}] is {values[index].tolist()}; expected finite numbers")


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals (vertex, 3) of an indexed surface; (0, 0, 1) where no face touches a vertex."""
    face_normals = normals_of(vertices[faces])
    sums = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(sums, faces[:, corner], face_normals)
    lengths = np.linalg.norm(sums, axis=-1, keepdims=True)
    return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), [0.0, 0.0, 1.0])


def unfolded(
    positions: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"], fans: Int[np.ndarray, " polygon"]
) -> Int[np.ndarray, "face 3"]:
    """The triangles of polygons, without overlaps and inside each polygon.

    Concave polygons, whose fans fold back, are triangulated in the plane that they face most.

    Args:
        faces: the polygons as fans around their first corners, one after the other.
        fans: the number of triangles of each polygon.
    """
    import manifold3d

    fans = fans[fans > 0]
    if fans.max(initial=0) < 2:
        return faces
    first = np.cumsum(fans) - fans
    with np.errstate(over="ignore", invalid="ignore"):  # Of coordinates that are refused later.
        normals = normals_of(positions[faces])
        normal = np.add.reduceat(normals, first)
        along = np.einsum("fi,fi->f", normals, np.repeat(normal, fans, axis=0))
        is_folded = np.minimum.reduceat(along, first) < -FOLDED * np.einsum("pi,pi->p", normal, normal)
    faces = faces.copy()
    for polygon in np.flatnonzero(is_folded):
        part = slice(first[polygon], first[polygon] + fans[polygon])
        loop = np.array([*faces[part][0, :2], *faces[part][:, 2]])
        axis = int(np.abs(normal[polygon]).argmax())
        flat = np.roll(positions[loop].astype(np.float64) - positions[loop[0]], -1 - axis, axis=1)[:, :2]
        counter_clockwise = flat if normal[polygon, axis] > 0 else flat[:, ::-1]
        triangles = np.asarray(manifold3d.triangulate([counter_clockwise]), np.int64).reshape(-1, 3)
        if len(triangles) == fans[polygon]:
            faces[part] = loop[triangles]
    return faces


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfacePoints:
    """Points on a mesh and the faces that they lie on."""

    face: Int[np.ndarray, " point"]
    position: Float[np.ndarray, "point 3"]


def points_on(
    mesh: Mesh, count: int, *, part: Int[np.ndarray, " face"] | None = None, count_a_part: int = 0
) -> SurfacePoints:
    """`count` points on the whole mesh, then `count_a_part` on each of its parts; the same ones every time.

    Args:
        part: the part of each face, counted from 0.
    """
    rng = np.random.default_rng(0)
    part = np.zeros(len(mesh.faces), np.int64) if part is None else part
    order = np.argsort(part, kind="stable")
    ends = np.cumsum(face_areas(mesh)[order])
    high = ends[np.searchsorted(part[order], np.arange(part.max() + 1), side="right") - 1]
    low = np.concatenate([[0.0], high[:-1]])
    on_parts = low + (high - low) * rng.random((count_a_part, len(high)))
    place = np.concatenate([ends[-1] * rng.random(count), on_parts.reshape(-1)])
    face = order[np.minimum(np.searchsorted(ends, place), len(order) - 1)]
    weights = rng.dirichlet([1.0, 1.0, 1.0], size=len(face))
    corners = face_corners(mesh)[face].astype(np.float64)
    return SurfacePoints(face=face, position=np.einsum("pk,pkc->pc", weights, corners))


PLASTIC = 1.32471795724474602596
"""The plastic number, on which the R2 sequence is based."""


def r2_steps(count: int) -> Float[np.ndarray, "point 2"]:
    """Points of the R2 sequence before the modulo: their fractional parts cover the unit square evenly for any count.

    Source: Roberts 2018, "The Unreasonable Effectiveness of Quasirandom Sequences".
    """
    return np.arange(count)[:, None] / PLASTIC ** np.arange(1, 3)
