"""Tests that each mesh of Mitsuba's serialized files is read, and that broken files are refused."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from datagen.disk.errors import HyalineError
from hyaline_import.foreign import MAX_TRIANGLES
from hyaline_import.mitsuba.scene import read_serialized

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")


def packed(flags: int, *parts: bytes, vertices: int = 3, faces: int = 1, version: int = 4) -> bytes:
    name = b"thing\0" if version == 4 else b""
    body = struct.pack("<I", flags) + name + struct.pack("<QQ", vertices, faces) + b"".join(parts)
    return struct.pack("<HH", 0x041C, version) + zlib.compress(body)


def serialized(*meshes: bytes, version: int = 4) -> bytes:
    offsets = np.cumsum([0, *map(len, meshes)])[:-1]
    width = "<u8" if version == 4 else "<u4"
    return b"".join(meshes) + offsets.astype(width).tobytes() + struct.pack("<I", len(meshes))


FACE = np.array([0, 1, 2], "<u4").tobytes()


@pytest.mark.parametrize("version", [3, 4])
def test_each_mesh_of_a_serialized_file_is_read(tmp_path: Path, version: int) -> None:
    uv = np.array([[0, 0], [1, 0], [0, 1]], "<f8")
    double = packed(0x2002, (2 * TRIANGLE).astype("<f8").tobytes(), uv.tobytes(), FACE, version=version)
    normals = np.tile(np.array([0, 0, 1], "<f4"), (3, 1)).tobytes()
    colors = np.zeros((3, 3), "<f4").tobytes()
    single = packed(0x1009, TRIANGLE.tobytes(), normals, colors, FACE, version=version)
    (tmp_path / "a.serialized").write_bytes(serialized(single, double, version=version))
    first, second = (read_serialized(tmp_path / "a.serialized", index) for index in (0, 1))
    np.testing.assert_array_equal(first.positions, TRIANGLE)
    np.testing.assert_array_equal(second.positions, 2 * TRIANGLE)
    assert first.normals is not None and first.uv is None and second.normals is None
    np.testing.assert_array_equal(second.uv, uv)
    assert (first.faces == [[0, 1, 2]]).all()


def test_what_is_packed_behind_a_mesh_is_never_unpacked(tmp_path: Path) -> None:
    bomb = struct.pack("<HH", 0x041C, 4) + zlib.compress(
        struct.pack("<I", 0x1000) + b"b\0" + struct.pack("<QQ", 3, 1) + TRIANGLE.tobytes() + FACE + bytes(1 << 27)
    )
    (tmp_path / "a.serialized").write_bytes(serialized(bomb))
    assert len(read_serialized(tmp_path / "a.serialized", 0).faces) == 1


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not a serialized mesh that can be read"),
        (b"PK\x03\x04 no mesh at all", "is not a serialized mesh of version 3 or 4"),
        (serialized(packed(0x1000, TRIANGLE.tobytes(), FACE))[:-4] + b"\xff" * 4, "has 4,294,967,295 meshes"),
        (serialized(packed(0x1000, TRIANGLE.tobytes(), FACE, faces=1 << 40)), "1,099,511,627,776 triangles"),
        (serialized(packed(0x1000, TRIANGLE.tobytes(), FACE, vertices=1 << 40)), "1,099,511,627,776 vertices"),
        (serialized(packed(0x1000, TRIANGLE.tobytes(), FACE, faces=MAX_TRIANGLES)), "holds .* of .* bytes"),
        (serialized(packed(0x1000, TRIANGLE.tobytes(), np.array([0, 1, 3], "<u4").tobytes())), "names vertex 3 of 3"),
        (serialized(packed(0x1000, (TRIANGLE * np.nan).tobytes(), FACE)), "a number is not finite"),
        (serialized(packed(0x1000, TRIANGLE.tobytes(), FACE)[:-9]), "not a serialized mesh that can be read"),
        (serialized(b"\x1c\x04\x04\x00not zlib at all"), "not a serialized mesh that can be read"),
    ],
)
def test_broken_serialized_files_are_refused(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "a.serialized").write_bytes(data)
    with pytest.raises(HyalineError, match=message):
        read_serialized(tmp_path / "a.serialized", 0)
