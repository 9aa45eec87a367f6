"""Triangle meshes: the record, its validation, and its PLY file."""

import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int32

from datagen.data.ply_polygons import triangulated
from datagen.disk.errors import HyalineError
from datagen.disk.records import read_regular, shown

MAX_EXTENT = 1e5
"""Largest coordinate accepted, in metres: beyond it float32 rays lose millimetres."""

MIN_AREA = 1e-14
"""Square metres below which a face counts as none: a tenth of a micrometre a side."""


MAX_PLY_BYTES = 1 << 30
"""Twenty million triangles."""
MAX_HEADER_BYTES = 1 << 16


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """A triangle mesh in world space with one normal and one uv per vertex.

    Vertices are split where the normal or the atlas has a seam, so a position may stand several times.
    Winding is counter-clockwise seen from outside.
    """

    vertices: Float32[np.ndarray, "vertex 3"]
    """Positions in metres, +z up."""
    faces: Int32[np.ndarray, "face 3"]
    """Vertex indices."""
    normals: Float32[np.ndarray, "vertex 3"]
    """Unit shading normals, outward."""
    uv: Float32[np.ndarray, "vertex 2"]
    """Atlas coordinates in [0, 1]; every surface point has texels of its own. v points up in the image."""


def no_mesh() -> Mesh:
    """The mesh without faces: that of an object that was removed from its scene, whose id stays unused."""
    pairs, triples = np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32)
    return Mesh(vertices=triples, faces=np.zeros((0, 3), np.int32), normals=triples, uv=pairs)


def is_there(mesh: Mesh) -> bool:
    """False for the mesh of a removed object."""
    return len(mesh.faces) > 0


def face_corners(mesh: Mesh) -> Float32[np.ndarray, "face 3 3"]:
    return mesh.vertices[mesh.faces]


def face_areas(mesh: Mesh) -> np.ndarray:
    """Areas in square metres, one a face, in float64."""
    a, b, c = np.moveaxis(face_corners(mesh).astype(np.float64), 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)


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
    """The connected component of each face (face,), counted from 0, on the welded surface."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    positions, faces = welded(mesh)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(len(positions),) * 2)
    _, component = connected_components(graph, directed=False)
    _, component = np.unique(component[faces[:, 0]], return_inverse=True)
    return component


def winding_number(point: np.ndarray, corners: np.ndarray) -> float:
    """How often the triangles (face, 3, 3) go around a point: 1 inside a closed outward surface, 0 outside.

    Source: Van Oosterom and Strackee 1983, the solid angle of a triangle.
    """
    a, b, c = np.moveaxis(corners.astype(np.float64) - point, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    numerator = np.einsum("fi,fi->f", a, np.cross(b, c))
    denominator = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return float(np.arctan2(numerator, denominator).sum() / (2 * np.pi))


def open_edges(mesh: Mesh) -> int:
    """The number of edges that are not shared by exactly two oppositely wound faces; 0 for a closed mesh."""
    _, faces = welded(mesh)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    base = directed.max() + 1
    forward, counts = np.unique(directed[:, 0] * base + directed[:, 1], return_counts=True)
    backward = np.unique(directed[:, 1] * base + directed[:, 0])
    return int((counts != 1).sum() + len(np.setdiff1d(forward, backward, assume_unique=True)))


def count_shared_faces(mesh: Mesh, other: Mesh) -> int:
    """The number of faces whose corners are all vertices of the other mesh too, to the last bit."""
    low, high = other.vertices.min(axis=0), other.vertices.max(axis=0)
    if (mesh.vertices.max(axis=0) < low).any() or (mesh.vertices.min(axis=0) > high).any():
        return 0
    # Adding 0 makes -0 the same bits as 0.
    keys, others = (np.ascontiguousarray(m.vertices + np.float32(0)).view("V12").reshape(-1) for m in (mesh, other))
    return int(np.isin(keys, others)[mesh.faces].all(axis=-1).sum())


def check_mesh(mesh: Mesh, *, where: str) -> None:
    """Refuses a mesh that would crash a native library or be rendered silently wrong.

    Raises:
        HyalineError: empty, non-finite or huge values, indices out of range, zero-area faces, uv outside [0, 1].
    """
    check_numbers(mesh, where=where)
    for name, values in (("normals", mesh.normals), ("uv", mesh.uv)):
        _check_finite(name, values, where=where)
    check_areas(mesh, where=where)
    if mesh.uv.min() < 0 or mesh.uv.max() > 1:
        raise HyalineError(f"{where}: uv spans {mesh.uv.min():g} to {mesh.uv.max():g}; expected [0, 1], unwrap it")


def check_numbers(mesh: Mesh, *, where: str) -> None:
    """Refuses a mesh that is empty, of arrays that do not fit, or anywhere but in a place that can be traced.

    Raises:
        HyalineError: what it is.
    """
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
    """Refuses faces without area.

    Raises:
        HyalineError: there is one.
    """
    if (areas := face_areas(mesh)).min() < MIN_AREA:
        raise HyalineError(f"{where}: face {int(areas.argmin())} has no area; remove degenerate faces")


def _check_finite(name: str, values: np.ndarray, *, where: str) -> None:
    if not np.isfinite(values).all():
        index = int(np.argwhere(~np.isfinite(values))[0, 0])
        raise HyalineError(f"{where}: {name}[{index}] is {values[index].tolist()}; expected finite numbers")


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals (vertex, 3) of an indexed surface; (0, 0, 1) where no face touches a vertex."""
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    face_normals = np.cross(b - a, c - a)
    sums = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(sums, faces[:, corner], face_normals)
    lengths = np.linalg.norm(sums, axis=-1, keepdims=True)
    return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), [0.0, 0.0, 1.0])


_OUR_HEADER = """ply
format binary_little_endian 1.0
comment https://github.com/mikedh/trimesh
element vertex {vertices}
property float x
property float y
property float z
property float nx
property float ny
property float nz
property double s
property double t
element face {faces}
property list uchar int vertex_indices
end_header
"""
"""Of every PLY that is written here: to the byte what trimesh 5.2 writes, as it did at first."""

_OUR_VERTEX = np.dtype([("vertices", "<f4", 3), ("normals", "<f4", 3), ("uv", "<f8", 2)])
_OUR_FACE = np.dtype([("count", "u1"), ("indices", "<i4", 3)])


def write_ply(mesh: Mesh) -> bytes:
    """Binary PLY with normals and uv (`s`, `t`): reading it back gives the same arrays."""
    vertices, faces = np.empty(len(mesh.vertices), _OUR_VERTEX), np.empty(len(mesh.faces), _OUR_FACE)
    vertices["vertices"], vertices["normals"], vertices["uv"] = mesh.vertices, mesh.normals, mesh.uv
    faces["count"], faces["indices"] = 3, mesh.faces
    header = _OUR_HEADER.format(vertices=len(vertices), faces=len(faces))
    return header.encode() + vertices.tobytes() + faces.tobytes()


def _read_our_ply(data: bytes) -> Mesh | None:
    """The mesh in the bytes that `write_ply` has written; None of any other PLY."""
    counts = re.findall(rb"element (?:vertex|face) (\d{1,9})\n", data[: len(_OUR_HEADER) + 16])
    if len(counts) != 2:
        return None
    num_vertices, num_faces = map(int, counts)
    header = _OUR_HEADER.format(vertices=num_vertices, faces=num_faces).encode()
    middle = len(header) + num_vertices * _OUR_VERTEX.itemsize
    if not num_faces or not data.startswith(header) or len(data) != middle + num_faces * _OUR_FACE.itemsize:
        return None
    vertices = np.frombuffer(data[len(header) : middle], _OUR_VERTEX)
    faces = np.frombuffer(data[middle:], _OUR_FACE)
    if (faces["count"] != 3).any():
        return None
    return Mesh(
        vertices=vertices["vertices"].astype(np.float32),
        faces=faces["indices"].astype(np.int32),
        normals=vertices["normals"].astype(np.float32),
        uv=vertices["uv"].astype(np.float32),
    )


def read_ply(path: Path) -> tuple[Mesh, bool]:
    """The mesh in a PLY file, and whether the file had uv (all uv are 0 where it had none).

    Missing normals are computed, smooth over shared vertices.

    Raises:
        HyalineError: the file is missing, truncated, or not a PLY of triangles.
    """
    data = read_regular(path, at_most=MAX_PLY_BYTES)
    if (ours := _read_our_ply(data)) is not None:
        _check_indices(ours.faces, len(ours.vertices), where=path)
        return ours, True
    _check_header(data, where=path)
    data = triangulated(data, where=path)
    # Slow to import, and not needed for what was written here.
    import trimesh

    try:
        loaded = trimesh.load(io.BytesIO(data), file_type="ply", process=False, fix_texture=False)
    # trimesh answers a broken file with eight kinds of exception (ValueError, KeyError, IndexError, ...).
    except Exception as error:
        raise HyalineError(f"{path}: not a PLY mesh that can be read ({type(error).__name__}: {error})") from error
    if not isinstance(loaded, trimesh.Trimesh):
        raise HyalineError(f"{path}: holds no triangles; expected a PLY mesh")
    raw = loaded.metadata["_ply_raw"]
    vertex = raw["vertex"]["data"]
    faces = np.asarray(loaded.faces)
    # trimesh 5.2 shortens a truncated ASCII file in silence; the header's counts tell. (Quads become two triangles.)
    promised = (raw["vertex"]["length"], raw["face"]["length"])
    if len(loaded.vertices) != promised[0] or faces.ndim != 2 or len(faces) < promised[1]:
        raise HyalineError(
            f"{path}: holds {len(loaded.vertices)} vertices and {len(faces)} faces, "
            f"its header says {promised[0]} and {promised[1]}; it is truncated, export it again"
        )
    names = vertex.dtype.names if isinstance(vertex, np.ndarray) else tuple(vertex)
    uv_names = next((pair for pair in (("s", "t"), ("u", "v")) if set(pair) <= set(names)), None)
    uv = np.stack([vertex[name] for name in uv_names], axis=-1) if uv_names else np.zeros((len(loaded.vertices), 2))
    _check_indices(faces, len(loaded.vertices), where=path)
    if {"nx", "ny", "nz"} <= set(names):
        normals = np.stack([vertex["nx"], vertex["ny"], vertex["nz"]], axis=-1)
    else:
        normals = vertex_normals(np.asarray(loaded.vertices), faces)
    mesh = Mesh(
        vertices=np.asarray(loaded.vertices, np.float32),
        faces=faces.astype(np.int32),
        normals=normals.reshape(-1, 3).astype(np.float32),
        uv=uv.reshape(-1, 2).astype(np.float32),
    )
    return mesh, uv_names is not None


def _check_header(data: bytes, *, where: Path) -> None:
    """Refuses what is no PLY, and promises that its bytes cannot keep: trimesh would set memory aside for them."""
    header, end, _ = data[:MAX_HEADER_BYTES].partition(b"end_header")
    if not data.startswith(b"ply") or not end:
        raise HyalineError(f"{where}: not a PLY mesh that can be read (it has no header); expected a PLY mesh")
    rest = len(data) - len(header) - len(end)
    for name, count in re.findall(rb"^\s*element\s+(\S+)\s+(\S+)\s*$", header, re.MULTILINE):
        if not count.isdigit() or len(count) > 12 or int(count) > rest:
            number, what = (shown(word.decode(errors="replace")) for word in (count, name))
            raise HyalineError(
                f"{where}: its header says {number} of {what}, in {rest:,} bytes; it is truncated, export it again"
            )


def _check_indices(faces: np.ndarray, num_vertices: int, *, where: Path) -> None:
    if len(faces) and (faces.min() < 0 or faces.max() >= num_vertices):
        raise HyalineError(
            f"{where}: a face names vertex {faces.min() if faces.min() < 0 else faces.max()}; "
            f"expected 0 to {num_vertices - 1}"
        )
