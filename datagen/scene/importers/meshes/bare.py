"""Files of triangles without materials: PLY and STL."""

import re
from pathlib import Path

import numpy as np

from datagen.data.ply import MAX_PLY_BYTES, read_ply
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
    header, _, _ = read_foreign(path, at_most=MAX_PLY_BYTES).partition(b"end_header")
    if re.search(rb"property\s+\w+\s+(red|diffuse_red)\b", header):
        remarks.approximate(path.name, "has colours at its vertices, which are left out")
    if re.search(rb"^comment\s+TextureFile\b", header, re.MULTILINE):
        remarks.approximate(path.name, "has a texture, which is left out; OBJ and glTF keep it")
    mesh, has_uv = read_ply(path)
    if len(mesh.faces) > MAX_TRIANGLES:
        raise HyalineError(f"{path}: holds {len(mesh.faces):,} triangles; expected at most {MAX_TRIANGLES:,}")
    if not np.isfinite(mesh.vertices).all():
        raise HyalineError(f"{path}: holds numbers that are not finite; export it again")
    item = ForeignObject(
        name=path.stem,
        positions=mesh.vertices.astype(np.float64),
        faces=mesh.faces,
        normals=mesh.normals if re.search(rb"property\s+\w+\s+nx\b", header) else None,
        uv=mesh.uv if has_uv else None,
        material=PLAIN,
    )
    return ForeignScene(objects=(item,), up="y")


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
