"""PLY files: written here, and read from anywhere; polygons become triangles."""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from datagen.data.meshes import Mesh, mesh_from, unfolded
from datagen.disk.errors import HyalineError, shown
from datagen.disk.storage import read_regular

MAX_PLY_BYTES = 1 << 30
"""Twenty million triangles."""
MAX_HEADER_BYTES = 1 << 16
MAX_POLYGONS = 4_000_000
"""Limit for lists of different lengths and for the triangles of polygons; both take more memory than triangles do."""
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
LETTERS = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
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


Rows = np.ndarray | list[np.ndarray]
Columns = dict[str, Rows]
"""The properties of an element, a row each; lists of different lengths are a list of arrays."""


def write_ply(mesh: Mesh) -> bytes:
    """Binary PLY with normals and uv (`s`, `t`); reading it back gives the same arrays."""
    vertices, faces = np.empty(len(mesh.vertices), _OUR_VERTEX), np.empty(len(mesh.faces), _OUR_FACE)
    vertices["vertices"], vertices["normals"], vertices["uv"] = mesh.vertices, mesh.normals, mesh.uv
    faces["count"], faces["indices"] = 3, mesh.faces
    header = _OUR_HEADER.format(vertices=len(vertices), faces=len(faces))
    return header.encode() + vertices.tobytes() + faces.tobytes()


def read_ply(path: Path) -> tuple[Mesh, bool]:
    """The mesh in a PLY file; see `decode_ply`."""
    return decode_ply(read_regular(path, at_most=MAX_PLY_BYTES), where=str(path))


def decode_ply(data: bytes, *, where: str) -> tuple[Mesh, bool]:
    """The mesh in the bytes of a PLY file, and whether the file has uv (otherwise all uv are 0).

    Missing normals are computed, smooth over shared vertices.
    """
    with _refusing(where):
        elements = _elements(data)
        vertex, face = elements["vertex"], elements.get("face")
        if not face:
            raise HyalineError(
                f"{where}: holds {shown(', '.join(elements))}, but no faces; expected a mesh of polygons"
            )
        positions = _stacked(vertex, "xyz")
        if not np.isfinite(positions).all():
            raise HyalineError(f"{where}: has positions that are not three finite numbers; export it again")
        faces = _triangles(face["vertex_indices" if "vertex_indices" in face else "vertex_index"], positions, where)
        has_normals = {"nx", "ny", "nz"} <= vertex.keys()
        normals = _stacked(vertex, ("nx", "ny", "nz")) if has_normals else None
        uv_names = next((pair for pair in ("st", "uv") if {*pair} <= vertex.keys()), None)
        uv = _stacked(vertex, uv_names) if uv_names else None
    return mesh_from(positions, faces, normals, uv), uv is not None


def _stacked(columns: Columns, names: Iterable[str]) -> np.ndarray:
    return np.stack([columns[name] for name in names], axis=-1)


@contextmanager
def _refusing(where: str) -> Iterator[None]:
    """Makes a HyalineError of what a broken file raises."""
    try:
        yield
    except (ValueError, KeyError, IndexError, TypeError, OverflowError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise HyalineError(f"{where}: not a PLY file that can be read ({reason}); export it again") from error


def _triangles(polygons: Rows, positions: np.ndarray, where: str) -> Int32[np.ndarray, "face 3"]:
    """The triangles of polygons."""
    sizes = np.array([len(polygon) for polygon in polygons])
    corners = polygons.reshape(-1) if isinstance(polygons, np.ndarray) else np.concatenate(polygons)
    if len(corners) and (corners.min() < 0 or corners.max() >= len(positions)):
        worst = corners.min() if corners.min() < 0 else corners.max()
        raise HyalineError(f"{where}: a face names vertex {worst:.0f}; expected 0 to {len(positions) - 1}")
    if (corners != np.rint(corners)).any():
        raise ValueError("a face names a vertex by a fraction")
    corners = corners.astype(np.int32)
    if (sizes == 3).all():
        return corners.reshape(-1, 3)
    fans = np.maximum(sizes - 2, 0)
    if (count := int(fans.sum())) > MAX_POLYGONS:
        raise HyalineError(f"{where}: holds polygons of {count:,} triangles; expected at most {MAX_POLYGONS:,}")
    corner = np.arange(count) - np.repeat(np.cumsum(fans) - fans, fans) + 1
    places = np.stack([np.zeros_like(corner), corner, corner + 1], axis=-1)
    return unfolded(positions, corners[np.repeat(np.cumsum(sizes) - sizes, fans)[:, None] + places], fans)


def _elements(data: bytes) -> dict[str, Columns]:
    header = re.match(rb"ply[ \t\r]*\n(.*?)^end_header[ \t\r]*\n", data[:MAX_HEADER_BYTES], re.DOTALL | re.MULTILINE)
    if header is None:
        raise ValueError("it has no header")
    at, lines = header.end(), [line.split() for line in header[1].decode("latin-1").split("\n")]
    form = next((line[1] for line in lines if line[:1] == ["format"]), "")
    order, is_text = ORDERS[form], form == "ascii"
    if is_text:  # From here on a file in binary, of doubles alone.
        data, at = np.array(data[at:].split(), np.float64).tobytes(), 0
    listed: list[tuple[str, int, list[tuple[str, list[np.dtype]]]]] = []
    for line in lines:
        match line:
            case ["element", name, count]:
                listed.append((name, int(count), []))
            case ["property", *kinds, name]:
                types = [np.dtype("f8" if is_text else order + LETTERS[kind]) for kind in kinds if kind != "list"]
                listed[-1][2].append((name, types))
    found = {}
    for name, count, properties in listed:
        found[name], at = _columns(data, at, count, properties) if count > 0 else ({}, at)
    if at != len(data):
        raise ValueError(f"it has {len(data) - at:,} bytes more than its header promises")
    return found


def _columns(data: bytes, at: int, count: int, properties: list[tuple[str, list[np.dtype]]]) -> tuple[Columns, int]:
    """The properties of an element's `count` rows from byte `at` on, and where the next element begins.

    A property has one type, or two if it is a list: that of its length comes first.
    """
    place, fields = at, []
    for name, types in properties:
        size = () if len(types) == 1 else (int(np.frombuffer(data, types[0], 1, place)[0]),)
        fields += [(f"{name} size", types[0])] * len(size) + [(name, types[-1], size)]
        place = at + np.dtype(fields).itemsize
    if at + count * (place - at) <= len(data):
        rows = np.frombuffer(data, fields, count, at)
        sizes = [rows[name] for name, *_ in fields if name.endswith(" size")]
        if all((size == size[0]).all() for size in sizes):
            return {name: rows[name] for name, _ in properties}, at + rows.nbytes
    # The lists differ in length.
    if count > MAX_POLYGONS:
        raise ValueError(f"it holds {count:,} lists; expected at most {MAX_POLYGONS:,} of different lengths")
    columns: dict[str, list[np.ndarray]] = {name: [] for name, _ in properties}
    for _ in range(count):
        for name, types in properties:
            size = 1
            if len(types) == 2:
                size = int(np.frombuffer(data, types[0], 1, at)[0])
                at += types[0].itemsize
            if size < 0:
                raise ValueError(f"it has a list of {size} numbers")
            columns[name].append(np.frombuffer(data, types[-1], size, at) if size else np.zeros(0, types[-1]))
            at += size * types[-1].itemsize
    return {**columns}, at
