"""Hostile PLY files: headers that lie, numbers that are none, faces of nothing, and bits that flipped."""

import struct

import numpy as np
from support.hostile.jsons import Case, named

PATH = "scene/meshes/pane.ply"
NUMBERS = ("nan", "inf", "-inf", "1e39", "1e6", "1e30", "-1e30", "1e-40", "x", "", "0x10", "1,5")
INDICES = ("-1", "4", "1000000", "2147483648", "-2147483648", "9223372036854775808", "1.5", "nan", "x", "")
COUNTS = ("0", "-1", "5", "1000", "2147483648", "9223372036854775808", "1000000000000", "x", "", "1.5", "nan", "1e3")
UVS = ("nan", "inf", "-0.1", "1.1", "1e30")

POINTS = ("-1 -1 0.5", "1 -1 0.5", "1 1 0.5", "-1 1 0.5")
UV = ("0 0", "1 0", "1 1", "0 1")
FACES = ("3 0 1 2", "3 0 2 3")


def ascii_ply(
    *,
    points: tuple[str, ...] = POINTS,
    uv: tuple[str, ...] = UV,
    faces: tuple[str, ...] = FACES,
    vertices: str | None = None,
    triangles: str | None = None,
    header: str = "",
) -> bytes:
    """A square in words."""
    lines = [
        "ply",
        "format ascii 1.0",
        *filter(None, [header]),
        f"element vertex {len(points) if vertices is None else vertices}",
        "property float x",
        "property float y",
        "property float z",
        "property float s",
        "property float t",
        f"element face {len(faces) if triangles is None else triangles}",
        "property list uchar int vertex_indices",
        "end_header",
        *(f"{point} {pair}" for point, pair in zip(points, uv, strict=False)),
        *faces,
    ]
    return ("\n".join(lines) + "\n").encode()


def binary_ply(
    *,
    order: str = "<",
    vertices: int = 4,
    triangles: int = 2,
    faces: tuple[tuple[int, ...], ...] = ((0, 1, 2), (0, 2, 3)),
    z: float = 0.5,
    count: str = "uchar",
    index: str = "int",
) -> bytes:
    """The same in bytes."""
    name = "binary_little_endian" if order == "<" else "binary_big_endian"
    header = (
        f"ply\nformat {name} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        f"property float s\nproperty float t\nelement face {triangles}\n"
        f"property list {count} {index} vertex_indices\nend_header\n"
    )
    corners = ((-1, -1, 0, 0), (1, -1, 1, 0), (1, 1, 1, 1), (-1, 1, 0, 1))
    body = b"".join(struct.pack(f"{order}5f", x, y, z, s, t) for x, y, s, t in corners)
    codes = {"uchar": "B", "int": "i", "uint": "I", "ushort": "H", "double": "d", "float": "f", "char": "b"}
    for face in faces:
        body += struct.pack(f"{order}{codes[count]}{len(face)}{codes[index]}", len(face), *face)
    return header.encode() + body


def mesh_cases(good: bytes) -> list[Case]:
    """All of them; `good` is the file as this package writes it."""
    contents: dict[str, bytes] = {
        "good ascii": ascii_ply(),
        "good binary": binary_ply(),
        "good big": binary_ply(order=">"),
    }
    for number in NUMBERS:
        contents[f"x = {number!r}"] = ascii_ply(points=(f"{number} -1 0.5", *POINTS[1:]))
    for number in UVS:
        contents[f"u = {number}"] = ascii_ply(uv=(f"{number} 0", *UV[1:]))
    for index in INDICES:
        contents[f"index = {index!r}"] = ascii_ply(faces=(f"3 0 1 {index}", FACES[1]))
    for count in COUNTS:
        contents[f"{count!r} vertices"] = ascii_ply(vertices=count)
        contents[f"{count!r} faces"] = ascii_ply(triangles=count)
    for corners in ("2 0 1", "0", "4 0 1 2 3", "255 0 1 2", "-1 0 1 2", "3 0 0 0", "3 2 1 0"):
        contents[f"face {corners}"] = ascii_ply(faces=(corners, FACES[1]))
    for name, header in {
        "comment": "comment \x1b[31mred",
        "second format": "format ascii 1.0",
        "unknown word": "elephant 3",
        "huge element": "element thing 99999999999",
        "absolute texture": "comment TextureFile /etc/passwd",
    }.items():
        contents[f"header with {name}"] = ascii_ply(header=header)
    contents |= {
        "no end_header": ascii_ply().replace(b"end_header\n", b""),
        "no format": ascii_ply().replace(b"format ascii 1.0\n", b""),
        "format 2.0": ascii_ply().replace(b"ascii 1.0", b"ascii 2.0"),
        "Windows lines": ascii_ply().replace(b"\n", b"\r\n"),
        "no z": ascii_ply(points=("-1 -1", "1 -1", "1 1", "-1 1")).replace(b"property float z\n", b""),
        "no faces": ascii_ply().replace(b"element face 2\nproperty list uchar int vertex_indices\n", b""),
        "faces without a list": ascii_ply().replace(b"list uchar int vertex_indices", b"int vertex_indices"),
        "faces of floats": ascii_ply().replace(b"uchar int", b"uchar float"),
        "unknown type": ascii_ply().replace(b"float x", b"quaternion x"),
        "wedge texture": ascii_ply(faces=("3 0 1 2 6 0 0 1 0 1 1", "3 0 2 3 6 0 0 1 1 0 1")).replace(
            b"vertex_indices\n", b"vertex_indices\nproperty list uchar float texcoord\n"
        ),
        "uv of zeros": ascii_ply(uv=("0 0",) * 4),
        "uv that overlaps": ascii_ply(uv=("0 0", "1 0", "1 1", "1 0")),
        "points of one place": ascii_ply(points=("0 0 0",) * 4),
        "text after the end": ascii_ply() + b"more and more\n",
        "bytes after the end": binary_ply() + bytes(100),
        "a long line": b"ply\n" + b"comment " + b"x" * 5_000_000 + b"\n" + ascii_ply()[4:],
        "binary that says ascii": binary_ply().replace(b"binary_little_endian", b"ascii"),
        "big that says little": binary_ply(order=">").replace(b"binary_big_endian", b"binary_little_endian"),
        "binary out of range": binary_ply(faces=((0, 1, 4), (0, 2, 3))),
        "binary below zero": binary_ply(faces=((0, 1, -5), (0, 2, 3))),
        "binary NaN": binary_ply(z=float("nan")),
        "binary 2^31 vertices": binary_ply(vertices=2**31),
        "binary too many vertices": binary_ply(vertices=5),
        "binary too many faces": binary_ply(triangles=3),
        "binary counts of ints": binary_ply(count="int"),
        "binary indices of uints": binary_ply(index="uint"),
        "binary indices of doubles": binary_ply(index="double"),
        "binary": bytes(range(256)) * 8,
        "a zip": b"PK\x03\x04" + bytes(100),
    }
    for size in np.linspace(1, len(good) - 1, 30).astype(int):
        contents[f"ours cut to {size}"] = good[:size]
    rng = np.random.default_rng(7)
    for number in range(90):
        spoilt = bytearray(good)
        place = int(rng.integers(len(good)))
        spoilt[place] ^= 1 << int(rng.integers(8))
        contents[f"ours with bit {number} flipped at {place}"] = bytes(spoilt)
    return named("ply", "scene", PATH, contents)
