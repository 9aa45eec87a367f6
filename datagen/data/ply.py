"""PLY files: written here, and read from anywhere; polygons become triangles."""

import io
import re
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from datagen.data.meshes import Mesh, unfolded, vertex_normals
from datagen.disk.errors import HyalineError
from datagen.disk.records import read_regular, shown

MAX_PLY_BYTES = 1 << 30
"""Twenty million triangles."""
MAX_HEADER_BYTES = 1 << 16

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
"""The header that trimesh 5.2 writes, which wrote the first of these files."""

_OUR_VERTEX = np.dtype([("vertices", "<f4", 3), ("normals", "<f4", 3), ("uv", "<f8", 2)])
_OUR_FACE = np.dtype([("count", "u1"), ("indices", "<i4", 3)])


def write_ply(mesh: Mesh) -> bytes:
    """Binary PLY with normals and uv (`s`, `t`); reading it back gives the same arrays."""
    vertices, faces = np.empty(len(mesh.vertices), _OUR_VERTEX), np.empty(len(mesh.faces), _OUR_FACE)
    vertices["vertices"], vertices["normals"], vertices["uv"] = mesh.vertices, mesh.normals, mesh.uv
    faces["count"], faces["indices"] = 3, mesh.faces
    header = _OUR_HEADER.format(vertices=len(vertices), faces=len(faces))
    return header.encode() + vertices.tobytes() + faces.tobytes()


def _read_our_ply(data: bytes) -> Mesh | None:
    """The mesh in bytes from `write_ply`; None for any other PLY."""
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
    """The mesh in a PLY file, and whether the file has uv (otherwise all uv are 0).

    Missing normals are computed, smooth over shared vertices.
    """
    data = read_regular(path, at_most=MAX_PLY_BYTES)
    if (ours := _read_our_ply(data)) is not None:
        _check_indices(ours.faces, len(ours.vertices), where=path)
        return ours, True
    _check_header(data, where=path)
    data, fans = triangulated(data, where=path)
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
    if isinstance(lists := raw["face"].get("data"), dict):  # A file in words.
        faces, fans = _fans_of(lists, faces)
    if fans is not None:
        faces = unfolded(np.asarray(loaded.vertices, np.float64), faces, fans)
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


def read_ply_points(path: Path) -> np.ndarray:
    """The positions in a PLY file of points, float64 (point, 3)."""
    data = read_regular(path, at_most=MAX_PLY_BYTES)
    _check_header(data, where=path)
    import trimesh

    try:
        points = np.asarray(trimesh.load(io.BytesIO(data), file_type="ply").vertices, np.float64)  # pyright: ignore[reportAttributeAccessIssue]
    except Exception as error:
        raise HyalineError(f"{path}: not a PLY of points ({type(error).__name__}: {error}); export it again") from error
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise HyalineError(f"{path}: has points that are not three finite numbers; export it again")
    return points


def _check_header(data: bytes, *, where: Path) -> None:
    """Raises unless the header's counts fit the file; trimesh would allocate memory for any count."""
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


def _fans_of(lists: Mapping[str, np.ndarray], triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """The faces that trimesh read from a file in words as fans, and how many triangles each has; or its triangles."""
    polygons = lists.get("vertex_index", lists.get("vertex_indices"))
    if polygons is None:
        return triangles, None
    sizes = np.array([len(polygon) for polygon in polygons])
    if sizes.max() < 4:
        return triangles, None
    fans = np.maximum(sizes - 2, 0)
    corners = np.repeat(np.cumsum(sizes) - sizes, fans)[:, None] + _corners_of(fans)
    return np.concatenate(polygons).astype(np.int64)[corners], fans


def _corners_of(fans: np.ndarray) -> np.ndarray:
    """The corners of the triangles of fans, counted from the first of their polygon."""
    corner = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans) + 1
    return np.stack([np.zeros_like(corner), corner, corner + 1], axis=-1)


def _check_indices(faces: np.ndarray, num_vertices: int, *, where: Path) -> None:
    if len(faces) and (faces.min() < 0 or faces.max() >= num_vertices):
        raise HyalineError(
            f"{where}: a face names vertex {faces.min() if faces.min() < 0 else faces.max()}; "
            f"expected 0 to {num_vertices - 1}"
        )


MAX_TRIANGLES = 4_000_000
"""Limit for polygons, which take more memory than triangles."""

PLY_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
"""NumPy's names for PLY's types of numbers."""


def triangulated(data: bytes, *, where: Path) -> tuple[bytes, np.ndarray | None]:
    """A binary PLY with its polygons as fans around their first corners, and how many triangles each has.

    Any other file is unchanged, without these numbers.

    trimesh 5.2 reads binary faces only if all have the same number of corners; Blender mixes triangles and quads.
    """
    end = data.index(b"end_header")
    begin = data.find(b"\n", end) + 1
    words = [[word.decode("latin-1") for word in line.split()] for line in data[:end].split(b"\n")]
    form = next((word[1] for word in words if word[:1] == ["format"] and len(word) == 3), "")
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
    starts = [place for place, word in enumerate(words) if word[:1] == ["element"] and len(word) == 3]
    if order is None or not begin or [words[place][1] for place in starts[:2]] != ["vertex", "face"]:
        return data, None
    bounds = [*starts, len(words)][:3]
    vertex, face = ([word for word in words[a:b] if word[:1] == ["property"]] for a, b in pairwise(bounds))
    lists = [place for place, word in enumerate(face) if len(word) == 5 and word[1] == "list"]
    if len(lists) != 1:
        return data, None
    (place,) = lists
    numbers = (vertex, face[:place], face[place + 1 :])
    kinds = [word[1] if len(word) == 3 else "" for part in numbers for word in part] + face[place][2:4]
    if not set(kinds) <= PLY_TYPES.keys():
        return data, None
    size_type, index_type = (np.dtype(order + PLY_TYPES[kind]) for kind in face[place][2:4])
    if "f" in size_type.kind + index_type.kind:
        return data, None
    stride, before, after = (sum(np.dtype(PLY_TYPES[word[1]]).itemsize for word in part) for part in numbers)
    num_vertices, num_faces = (int(words[line][2]) for line in starts[:2])
    first_face = begin + num_vertices * stride
    if _are_triangles(data, first_face, num_faces, size_type, before, 3 * index_type.itemsize + after):
        return data, None
    _check_number(num_faces, where=where)
    found = _list_places(data, first_face, num_faces, size_type, index_type.itemsize, before, after)
    if found is None:
        return data, None
    places, sizes, rest = found
    if rest and len(starts) == 2:
        return data, None  # Its counts are wrong, which trimesh says.
    fans = np.maximum(sizes - 2, 0)
    _check_number(int(fans.sum()), where=where)
    at = np.repeat(places, fans)[:, None] + index_type.itemsize * _corners_of(fans)
    indices = np.frombuffer(data, np.uint8)[at[..., None] + np.arange(index_type.itemsize)].view(index_type)[..., 0]
    triangles = np.empty(len(indices), np.dtype([("count", "u1"), ("indices", order + "i4", 3)]))
    triangles["count"], triangles["indices"] = 3, indices
    head = [
        *words[: starts[1]],
        ["element", "face", str(len(triangles))],
        ["property", "list", "uchar", "int", "vertex_indices"],
    ]
    header = "".join(" ".join(line) + "\n" for line in [*head, ["end_header"]])
    return header.encode("latin-1") + data[begin:first_face] + triangles.tobytes(), fans


def _are_triangles(data: bytes, at: int, count: int, size_type: np.dtype, before: int, after: int) -> bool:
    stride = before + size_type.itemsize + after
    if at + count * stride > len(data):
        return False
    faces = np.frombuffer(data, np.uint8, count * stride, at).reshape(count, stride)
    return bool((faces[:, before : before + size_type.itemsize] == np.array([3], size_type).view(np.uint8)).all())


def _check_number(count: int, *, where: Path) -> None:
    if count > MAX_TRIANGLES:
        raise HyalineError(f"{where}: holds {count:,} polygons or triangles; expected at most {MAX_TRIANGLES:,}")


def _list_places(
    data: bytes, at: int, count: int, size_type: np.dtype, index_bytes: int, before: int, after: int
) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Offset and length of each face's list, and the bytes after the last; None if the file is truncated."""
    order = "big" if size_type.byteorder == ">" else "little"
    places, sizes = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for face in range(count):
        place = at + before + size_type.itemsize
        size = int.from_bytes(data[at + before : place], order)
        at = place + index_bytes * size + after
        if at > len(data):
            return None
        places[face], sizes[face] = place, size
    return places, sizes, len(data) - at
