"""Files of triangles without materials: PLY and STL."""

import re
from pathlib import Path

import numpy as np

from datagen.data.ply import MAX_PLY_BYTES, PLY_TYPES, read_ply
from datagen.disk.errors import HyalineError
from datagen.scene.importers.foreign import (
    MAX_TRIANGLES,
    PLAIN,
    ForeignObject,
    ForeignScene,
    read_foreign,
)
from datagen.scene.importers.remarks import Remarks

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t\r]*$", re.MULTILINE)


def read_ply_file(path: Path, remarks: Remarks) -> ForeignScene:
    """The surface of a PLY file."""
    data = read_foreign(path, at_most=MAX_PLY_BYTES)
    header = data[: data.find(b"end_header")]
    if re.search(rb"property\s+\w+\s+(red|diffuse_red)\b", header):
        remarks.approximate(path.name, "has colours at its vertices, which are left out")
    if re.search(rb"^element\s+tristrips\s", header, re.MULTILINE):
        try:
            positions, faces = _strips(data, path)
        except (ValueError, KeyError, IndexError, TypeError, OverflowError) as error:
            raise HyalineError(f"{path}: not a PLY that can be read ({type(error).__name__}: {error})") from error
        normals = uv = None
    else:
        mesh, has_uv = read_ply(path)
        positions, faces = mesh.vertices.astype(np.float64), mesh.faces
        normals = mesh.normals if re.search(rb"property\s+\w+\s+nx\b", header) else None
        uv = mesh.uv if has_uv else None
    if not len(faces):
        raise HyalineError(f"{path}: holds no faces; expected a mesh, a cloud of points cannot be rendered")
    if len(faces) > MAX_TRIANGLES:
        raise HyalineError(f"{path}: holds {len(faces):,} triangles; expected at most {MAX_TRIANGLES:,}")
    if not np.isfinite(positions).all():
        raise HyalineError(f"{path}: holds numbers that are not finite; export it again")
    item = ForeignObject(name=path.stem, positions=positions, faces=faces, normals=normals, uv=uv, material=PLAIN)
    return ForeignScene(objects=(item,), up="y")


def _strips(data: bytes, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions and faces of a file of triangle strips, which -1 parts, as Stanford's scans have them."""
    end = data.find(b"end_header")
    head = data[:end].decode("latin-1").split("\n")
    body = data[data.find(b"\n", end) + 1 :]
    words = [line.split() for line in head if line.strip()]
    form = next((word[1] for word in words if word[0] == "format" and len(word) > 1), "")
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
    elements = [word for word in words if word[0] == "element" and len(word) == 3]
    properties = _properties(words)
    if order is None or [word[1] for word in elements] != ["vertex", "tristrips"] or elements[1][2] != "1":
        raise HyalineError(f"{path}: not a PLY that can be read; expected vertices, then one element of tristrips")
    count = int(elements[0][2]) if elements[0][2].isdigit() and len(elements[0][2]) < 10 else 0
    if order == "":
        numbers = body.split()
        width = len(properties["vertex"])
        vertex = np.array(numbers[: count * width], np.float64).reshape(-1, width)
        places = [[name for name, _ in properties["vertex"]].index(axis) for axis in "xyz"]
        rest = np.array(numbers[count * width :], np.int64)
        positions, strip = vertex[:, places], rest[1:]
        promised = int(rest[0]) if len(rest) else -1
    else:
        dtype = np.dtype([(name, order + PLY_TYPES.get(kind, "")) for name, kind in properties["vertex"]])
        lists = [word for word in words if word[:2] == ["property", "list"]]
        size_type, index_type = (np.dtype(order + PLY_TYPES.get(kind, "")) for kind in lists[-1][2:4])
        if count * dtype.itemsize + size_type.itemsize > len(body):
            raise HyalineError(
                f"{path}: its header promises {count:,} vertices, and the file ends before; export it again"
            )
        vertex = np.frombuffer(body, dtype, count)
        positions = np.stack([vertex[axis] for axis in "xyz"], axis=-1).astype(np.float64)
        at = count * dtype.itemsize
        promised = int(np.frombuffer(body, size_type, 1, at)[0])
        strip = np.frombuffer(body[at + size_type.itemsize :], np.uint8)
        strip = strip[: len(strip) // index_type.itemsize * index_type.itemsize].view(index_type).astype(np.int64)
    if not count or promised < 3 or len(strip) < promised or len(positions) != count:
        raise HyalineError(f"{path}: promises a strip of {promised:,} indices; it is cut off, export it again")
    strip = strip[:promised]
    if strip.max() >= count or strip.min() < -1:
        raise HyalineError(f"{path}: a strip names vertex {strip.max()}; expected 0 to {count - 1}, or -1")
    return positions, _faces(strip)


def _properties(words: list[list[str]]) -> dict[str, list[tuple[str, str]]]:
    found: dict[str, list[tuple[str, str]]] = {}
    element = ""
    for word in words:
        if word[0] == "element" and len(word) == 3:
            element = word[1]
            found[element] = []
        elif word[0] == "property" and len(word) == 3:
            found.setdefault(element, []).append((word[2], word[1]))
    return found


def _faces(strip: np.ndarray) -> np.ndarray:
    """Triangles of strips; of every second one in its strip, two corners change places."""
    place = np.arange(len(strip))
    begin = np.maximum.accumulate(np.where(strip < 0, place + 1, 0))
    corners = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=-1)
    is_odd = (place - begin)[:-2] % 2 == 1
    corners[is_odd] = corners[is_odd][:, [1, 0, 2]]
    distinct = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 2] != corners[:, 0])
    return corners[(corners >= 0).all(axis=-1) & distinct]


# STL


def read_stl(path: Path, remarks: Remarks) -> ForeignScene:  # noqa: ARG001
    """The triangles of an STL file."""
    data = read_foreign(path)
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and len(data) == 84 + _TRIANGLE.itemsize * count:
        corners = np.frombuffer(data, _TRIANGLE, count, 84)["corners"].astype(np.float64)
    elif data.lstrip()[:5].lower() == b"solid":
        corners = _text(data, path)
    else:
        raise HyalineError(
            f"{path}: has {len(data):,} bytes for {count:,} triangles of 50 bytes; it is cut off, or not an STL file"
        )
    if not 0 < len(corners) <= MAX_TRIANGLES:
        raise HyalineError(f"{path}: holds {len(corners):,} triangles; expected 1 to {MAX_TRIANGLES:,}")
    if not np.isfinite(corners).all():
        raise HyalineError(f"{path}: holds numbers that are not finite; export it again")
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    item = ForeignObject(
        name=path.stem, positions=corners.reshape(-1, 3), faces=faces, normals=None, uv=None, material=PLAIN
    )
    return ForeignScene(objects=(item,), up="z", metres=0.001)


def _text(data: bytes, path: Path) -> np.ndarray:
    words = _VERTEX.findall(data)
    try:
        values = np.array(words, np.float64)
    except ValueError as error:
        raise HyalineError(f"{path}: not an STL file that can be read ({error})") from None
    if len(words) % 3 or data.count(b"endfacet") * 3 != len(words) or b"endsolid" not in data:
        raise HyalineError(f"{path}: ends in the middle of a facet; it is cut off, export it again")
    return values.reshape(-1, 3, 3)
