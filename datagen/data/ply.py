"""PLY files: written here, and read from anywhere; polygons become triangles."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int, Int64

from datagen.data.meshes import Mesh, unfolded, vertex_normals
from datagen.disk.errors import HyalineError
from datagen.disk.records import read_regular, shown

MAX_PLY_BYTES = 1 << 30
"""Twenty million triangles."""
MAX_HEADER_BYTES = 1 << 16
MAX_POLYGONS = 4_000_000
"""Limit for lists of different lengths and for the triangles of polygons; both take more memory than triangles do."""
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LETTERS = {
    **{"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"},
    **{"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I"},
    **{"float32": "f", "float64": "d"},
}
"""NumPy's letters for PLY's types of numbers."""

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


def read_ply(path: Path) -> tuple[Mesh, bool]:
    """The mesh in a PLY file, and whether the file has uv (otherwise all uv are 0).

    Missing normals are computed, smooth over shared vertices.
    """
    with _reading(path) as elements:
        vertex = elements["vertex"]
        positions = _positions(vertex, where=path)
        faces = _faces(elements.get("face", {}), positions, where=path)
        if not len(faces):
            raise HyalineError(f"{path}: holds {shown(', '.join(elements))}, but no faces; expected a mesh of polygons")
        has_normals = {"nx", "ny", "nz"} <= vertex.keys()
        normals = _stacked(vertex, ("nx", "ny", "nz")) if has_normals else vertex_normals(positions, faces)
        uv_names = next((pair for pair in (("s", "t"), ("u", "v")) if set(pair) <= vertex.keys()), None)
        uv = _stacked(vertex, uv_names) if uv_names else np.zeros((len(positions), 2))
    mesh = Mesh(
        vertices=positions.astype(np.float32),
        faces=faces.astype(np.int32),
        normals=normals.astype(np.float32),
        uv=uv.astype(np.float32),
    )
    return mesh, uv_names is not None


def read_ply_points(path: Path) -> Float64[np.ndarray, "point 3"]:
    """The positions in a PLY file of points."""
    with _reading(path) as elements:
        return _positions(elements["vertex"], where=path).astype(np.float64)


class _Column(NamedTuple):
    """A property of all rows of an element."""

    values: np.ndarray
    """Those of lists one after the other."""
    sizes: Int[np.ndarray, " row"]
    """How many numbers each row has: 1, unless the property is a list."""


class _Property(NamedTuple):
    name: str
    dtype: np.dtype
    size: np.dtype | None
    """Type of the number that says how long a list is."""


Columns = dict[str, _Column]


def _stacked(columns: Columns, names: tuple[str, ...]) -> np.ndarray:
    return np.stack([columns[name].values for name in names], axis=-1)


def _positions(vertex: Columns, *, where: Path) -> np.ndarray:
    positions = _stacked(vertex, ("x", "y", "z"))
    if not np.isfinite(positions).all():
        raise HyalineError(f"{where}: has positions that are not three finite numbers; export it again")
    return positions


def _faces(columns: Columns, positions: np.ndarray, *, where: Path) -> Int64[np.ndarray, "face 3"]:
    """Triangles of the polygons."""
    if not columns:
        return np.zeros((0, 3), np.int64)
    corners, sizes = columns.get("vertex_indices") or columns["vertex_index"]
    if len(corners) and (corners.min() < 0 or corners.max() >= len(positions)):
        worst = corners.min() if corners.min() < 0 else corners.max()
        raise HyalineError(f"{where}: a face names vertex {worst:.0f}; expected 0 to {len(positions) - 1}")
    if corners.dtype.kind == "f" and not np.array_equal(corners, np.rint(corners)):
        raise ValueError("a face names a vertex by a fraction")
    corners = corners.astype(np.int64)
    if (sizes == 3).all():
        return corners.reshape(-1, 3)
    fans = np.maximum(sizes - 2, 0)
    if (count := int(fans.sum())) > MAX_POLYGONS:
        raise HyalineError(f"{where}: holds polygons of {count:,} triangles; expected at most {MAX_POLYGONS:,}")
    corner = np.arange(count) - np.repeat(np.cumsum(fans) - fans, fans) + 1
    places = np.stack([np.zeros_like(corner), corner, corner + 1], axis=-1)
    return unfolded(positions, corners[np.repeat(np.cumsum(sizes) - sizes, fans)[:, None] + places], fans)


@contextmanager
def _reading(path: Path) -> Iterator[dict[str, Columns]]:
    """The columns of a PLY file by element and property; what a broken file raises becomes a HyalineError."""
    data = read_regular(path, at_most=MAX_PLY_BYTES)
    try:
        yield _elements(data)
    except (ValueError, KeyError, IndexError, TypeError, OverflowError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise HyalineError(f"{path}: not a PLY file that can be read ({reason}); export it again") from error


def _elements(data: bytes) -> dict[str, Columns]:
    header = re.match(rb"ply[ \t\r]*\n(.*?)^end_header[ \t\r]*\n", data[:MAX_HEADER_BYTES], re.DOTALL | re.MULTILINE)
    if header is None:
        raise ValueError("it has no header")
    at, lines = header.end(), [line.split() for line in header[1].decode("latin-1").split("\n")]
    form = next((line[1] for line in lines if line[:1] == ["format"]), "")
    order, is_text = ORDERS[form], form == "ascii"

    def dtype(kind: str) -> np.dtype:
        return np.dtype(np.float64) if is_text else np.dtype(order + LETTERS[kind])

    listed: list[tuple[str, int, list[_Property]]] = []
    for line in lines:
        match line:
            case ["element", name, count]:
                listed.append((name, int(count), []))
            case ["property", "list", size, kind, name]:
                listed[-1][2].append(_Property(name, dtype(kind), dtype(size)))
            case ["property", kind, name]:
                listed[-1][2].append(_Property(name, dtype(kind), None))
    if is_text:  # From here on a file in binary, of doubles alone.
        data, at = np.array(data[at:].split(), np.float64).tobytes(), 0
    found = {}
    for name, count, properties in listed:
        found[name], at = _columns(data, at, count, properties)
    if at != len(data):
        raise ValueError(f"it has {len(data) - at:,} bytes more than its header promises")
    return found


def _columns(data: bytes, at: int, count: int, properties: list[_Property]) -> tuple[Columns, int]:
    """The properties of an element's `count` rows from byte `at` on, and where the next element begins."""
    if count < 1:
        return {}, at
    first, after = _row(data, at, properties)
    stride = after - at

    def all_rows(place: int, dtype: np.dtype, size: int) -> np.ndarray:
        return np.ndarray((count, size), dtype, data, place, (stride, dtype.itemsize))

    spans = list(zip(properties, first, strict=True))
    if at + count * stride <= len(data) and all(
        (all_rows(place - kind.itemsize, kind, 1) == size).all()
        for (_, _, kind), (place, size) in spans
        if kind is not None
    ):
        return {
            name: _Column(all_rows(place, dtype, size).reshape(-1), np.broadcast_to(size, count))
            for (name, dtype, _), (place, size) in spans
        }, at + count * stride
    # The lists differ in length.
    if count > MAX_POLYGONS:
        raise ValueError(f"it holds {count:,} lists; expected at most {MAX_POLYGONS:,} of different lengths")
    rows = []
    for _ in range(count):
        row, at = _row(data, at, properties)
        rows.append(row)
    columns = {}
    for (name, dtype, _), spans in zip(properties, zip(*rows, strict=True), strict=True):
        packed = b"".join(data[place : place + size * dtype.itemsize] for place, size in spans)
        columns[name] = _Column(np.frombuffer(packed, dtype), np.array([size for _, size in spans]))
    return columns, at


def _row(data: bytes, at: int, properties: list[_Property]) -> tuple[list[tuple[int, int]], int]:
    """Where each property of a row begins, how many numbers it has, and where the next row begins."""
    spans = []
    for _, dtype, kind in properties:
        size = 1
        if kind is not None:
            size = int(np.frombuffer(data, kind, 1, at)[0])
            at += kind.itemsize
        if size < 0:
            raise ValueError(f"it has a list of {size} numbers")
        spans.append((at, size))
        at += size * dtype.itemsize
    if at > len(data):
        raise ValueError("it is cut off")
    return spans, at
