"""Binary PLY files of polygons, rewritten as files of triangles."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from datagen.disk.errors import HyalineError

MAX_TRIANGLES = 4_000_000
"""Of polygons, which take more memory than a file of triangles."""

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


def triangulated(data: bytes, *, where: Path) -> bytes:
    """A binary PLY whose polygons have become triangles around their first corners; any other file as it is.

    trimesh 5.2 reads binary faces only where all have as many corners; Blender writes triangles beside quads.

    Raises:
        HyalineError: they would be more than `MAX_TRIANGLES`.
    """
    end = data.index(b"end_header")
    begin = data.find(b"\n", end) + 1
    words = [[word.decode("latin-1") for word in line.split()] for line in data[:end].split(b"\n")]
    form = next((word[1] for word in words if word[:1] == ["format"] and len(word) == 3), "")
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
    starts = [place for place, word in enumerate(words) if word[:1] == ["element"] and len(word) == 3]
    if order is None or not begin or [words[place][1] for place in starts[:2]] != ["vertex", "face"]:
        return data
    bounds = [*starts, len(words)][:3]
    vertex, face = ([word for word in words[a:b] if word[:1] == ["property"]] for a, b in pairwise(bounds))
    lists = [place for place, word in enumerate(face) if len(word) == 5 and word[1] == "list"]
    if len(lists) != 1:
        return data
    (place,) = lists
    numbers = (vertex, face[:place], face[place + 1 :])
    kinds = [word[1] if len(word) == 3 else "" for part in numbers for word in part] + face[place][2:4]
    if not set(kinds) <= PLY_TYPES.keys():
        return data
    size_type, index_type = (np.dtype(order + PLY_TYPES[kind]) for kind in face[place][2:4])
    if "f" in size_type.kind + index_type.kind:
        return data
    stride, before, after = (sum(np.dtype(PLY_TYPES[word[1]]).itemsize for word in part) for part in numbers)
    num_vertices, num_faces = (int(words[line][2]) for line in starts[:2])
    first_face = begin + num_vertices * stride
    if _are_triangles(data, first_face, num_faces, size_type, before, 3 * index_type.itemsize + after):
        return data
    _check_number(num_faces, where=where)
    found = _list_places(data, first_face, num_faces, size_type, index_type.itemsize, before, after)
    if found is None:
        return data
    places, sizes, rest = found
    if rest and len(starts) == 2:
        return data  # Its counts are wrong, which trimesh says.
    fans = np.maximum(sizes - 2, 0)
    _check_number(int(fans.sum()), where=where)
    corner = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans) + 1
    corners = np.stack([np.zeros_like(corner), corner, corner + 1], axis=-1)
    at = np.repeat(places, fans)[:, None] + index_type.itemsize * corners
    indices = np.frombuffer(data, np.uint8)[at[..., None] + np.arange(index_type.itemsize)].view(index_type)[..., 0]
    triangles = np.empty(len(indices), np.dtype([("count", "u1"), ("indices", order + "i4", 3)]))
    triangles["count"], triangles["indices"] = 3, indices
    head = [
        *words[: starts[1]],
        ["element", "face", str(len(triangles))],
        ["property", "list", "uchar", "int", "vertex_indices"],
    ]
    header = "".join(" ".join(line) + "\n" for line in [*head, ["end_header"]])
    return header.encode("latin-1") + data[begin:first_face] + triangles.tobytes()


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
    """Where the list of each face begins, how long it is, and bytes after the last; None where the file is cut off."""
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
