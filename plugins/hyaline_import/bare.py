"""Files of triangles without materials: PLY and STL."""

import re
from pathlib import Path

import numpy as np

from datagen.data.ply import MAX_PLY_BYTES, read_ply
from datagen.disk.errors import HyalineError
from hyaline_import.foreign import (
    MAX_TRIANGLES,
    PLAIN,
    ForeignObject,
    ForeignScene,
    read_foreign,
)
from hyaline_import.remarks import Remarks

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_SOLID = re.compile(rb"^[ \t]*solid\b", re.MULTILINE)
_VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t\r]*$", re.MULTILINE)


def read_ply_file(path: Path, remarks: Remarks) -> ForeignScene:
    """The surface of a PLY file."""
    header, _, _ = read_foreign(path, at_most=MAX_PLY_BYTES).partition(b"end_header")
    if re.search(rb"property\s+\w+\s+(red|diffuse_red)\b", header):
        remarks.approximate(path.name, "has colours at its vertices, which are left out")
    if re.search(rb"^comment\s+TextureFile\b", header, re.MULTILINE):
        remarks.approximate(path.name, "has a texture, which is left out; OBJ and glTF keep it")
    mesh, has_uv = read_ply(path)
    item = ForeignObject(
        name=path.stem,
        positions=mesh.vertices.astype(np.float64),
        faces=mesh.faces,
        normals=mesh.normals if re.search(rb"property\s+\w+\s+nx\b", header) else None,
        uv=mesh.uv if has_uv else None,
        material=PLAIN,
    )
    return ForeignScene(objects=_checked(item, path), up="y")


def read_stl(path: Path, remarks: Remarks) -> ForeignScene:  # noqa: ARG001
    """The triangles of an STL file as one surface, in millimetres."""
    data = read_foreign(path)
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and len(data) == 84 + _TRIANGLE.itemsize * count:
        positions = np.frombuffer(data, _TRIANGLE, count, 84)["corners"].astype(np.float64).reshape(-1, 3)
    elif data.lstrip()[:5].lower() == b"solid":
        positions = _positions(data.lower(), path)
    else:
        raise HyalineError(
            f"{path}: has {len(data):,} bytes for {count:,} triangles of 50 bytes; it is cut off, or not an STL file"
        )
    faces = np.arange(len(positions)).reshape(-1, 3)
    item = ForeignObject(name=path.stem, positions=positions, faces=faces, normals=None, uv=None, material=PLAIN)
    return ForeignScene(objects=_checked(item, path), up="z", metres=0.001)


def _positions(text: bytes, path: Path) -> np.ndarray:
    """The corners in a file of text, of all its solids."""
    words = _VERTEX.findall(text)
    if len(words) != 3 * text.count(b"endfacet") or text.count(b"endsolid") < len(_SOLID.findall(text)):
        raise HyalineError(f"{path}: ends in the middle of a facet; it is cut off, export it again")
    try:
        return np.array(words, np.float64).reshape(-1, 3)
    except ValueError as error:
        raise HyalineError(f"{path}: not an STL file that can be read ({error})") from None


def _checked(item: ForeignObject, path: Path) -> tuple[ForeignObject, ...]:
    if not 0 < len(item.faces) <= MAX_TRIANGLES:
        raise HyalineError(f"{path}: holds {len(item.faces):,} triangles; expected 1 to {MAX_TRIANGLES:,}")
    if not np.isfinite(item.positions).all():
        raise HyalineError(f"{path}: holds numbers that are not finite; export it again")
    return (item,)
