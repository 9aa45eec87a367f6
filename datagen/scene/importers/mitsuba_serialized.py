"""Mitsuba's serialized meshes: several in a file, each compressed by zlib.

Source: the documentation of Mitsuba's plugin `serialized`.
"""

import struct
import zlib
from pathlib import Path

import numpy as np

from datagen.disk.errors import HyalineError
from datagen.scene.importers.foreign import MAX_TRIANGLES, ForeignObject, read_foreign
from datagen.scene.importers.obj import PLAIN

MAGIC = 0x041C
NORMALS, UV, COLORS, DOUBLE = 0x0001, 0x0002, 0x0008, 0x2000
MAX_NAME = 4096
MAX_MESHES = 20_000


def read_serialized(path: Path, index: int) -> ForeignObject:
    """One mesh of a file; nothing is unpacked beyond what its counts promise.

    Raises:
        HyalineError: no such file, no such mesh in it, or one that is too large.
    """
    data = read_foreign(path)
    try:
        stream, version = _stream(data, index, path)
        return _mesh(stream, version, path)
    except (struct.error, zlib.error, ValueError, UnicodeDecodeError) as error:
        raise HyalineError(f"{path}: not a serialized mesh that can be read ({error}); export it as PLY") from None


def _stream(data: bytes, index: int, path: Path) -> tuple[bytes, int]:
    """The compressed bytes of a mesh, and its format's version."""
    magic, version = struct.unpack_from("<HH", data)
    if magic != MAGIC or version not in (3, 4):
        raise HyalineError(f"{path}: is no serialized mesh of version 3 or 4; export it as PLY")
    (count,) = struct.unpack_from("<I", data, len(data) - 4)
    width = "Q" if version == 4 else "I"
    if not 1 <= count <= MAX_MESHES or not 0 <= index < count:
        raise HyalineError(f"{path}: has {count:,} meshes; expected 1 to {MAX_MESHES:,}, and shape_index {index} in it")
    offsets = struct.unpack_from(f"<{count}{width}", data, len(data) - 4 - count * struct.calcsize(f"<{width}"))
    ends = [*offsets[1:], len(data)]
    if offsets[index] >= len(data):
        raise ValueError(f"mesh {index} is said to begin at byte {offsets[index]:,} of {len(data):,}")
    magic, version = struct.unpack_from("<HH", data, offsets[index])
    if magic != MAGIC or version not in (3, 4):
        raise ValueError(f"mesh {index} is not where the file says")
    return data[offsets[index] + 4 : ends[index]], version


def _mesh(stream: bytes, version: int, path: Path) -> ForeignObject:
    unpacker = zlib.decompressobj()
    head = unpacker.decompress(stream, MAX_NAME + 64)
    (flags,) = struct.unpack_from("<I", head)
    at, name = 4, path.stem
    if version == 4:
        end = head.index(b"\0", at)
        name, at = head[at:end].decode() or name, end + 1
    vertices, faces = struct.unpack_from("<QQ", head, at)
    at += 16
    if not (0 < vertices <= 3 * MAX_TRIANGLES and 0 < faces <= MAX_TRIANGLES):
        raise HyalineError(
            f"{path}: holds {vertices:,} vertices and {faces:,} triangles; expected 1 to {MAX_TRIANGLES:,} triangles"
        )
    kind = np.dtype("<f8" if flags & DOUBLE else "<f4")
    floats = 3 + 3 * bool(flags & NORMALS) + 2 * bool(flags & UV) + 3 * bool(flags & COLORS)
    size = at + vertices * floats * kind.itemsize + faces * 12
    body = head + unpacker.decompress(unpacker.unconsumed_tail, max(size - len(head), 1))
    if len(body) < size:
        raise ValueError(f"holds {len(body):,} of {size:,} bytes")

    def take(columns: int, dtype: np.dtype, rows: int) -> np.ndarray:
        nonlocal at
        values = np.frombuffer(body, dtype, rows * columns, at).reshape(rows, columns)
        at += values.nbytes
        return values

    positions = take(3, kind, vertices).astype(np.float64)
    normals = take(3, kind, vertices).astype(np.float64) if flags & NORMALS else None
    uv = take(2, kind, vertices).astype(np.float64) if flags & UV else None
    if flags & COLORS:
        take(3, kind, vertices)
    corners = take(3, np.dtype("<u4"), faces).astype(np.int64)
    if corners.max() >= vertices:
        raise ValueError(f"a triangle names vertex {corners.max():,} of {vertices:,}")
    if not all(np.isfinite(values).all() for values in (positions, normals, uv) if values is not None):
        raise ValueError("a number is not finite")
    return ForeignObject(name=name, positions=positions, faces=corners, normals=normals, uv=uv, material=PLAIN)
