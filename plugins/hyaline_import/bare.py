"""Files of triangles without materials: PLY and STL."""

import re
from pathlib import Path

import numpy as np

from datagen.data.ply import MAX_PLY_BYTES, read_ply
from datagen.disk.errors import HyalineError
from hyaline_import.foreign import (
    MAX_SURFACES,
    MAX_TRIANGLES,
    PLAIN,
    ForeignObject,
    ForeignScene,
    read_foreign,
)
from hyaline_import.remarks import Remarks

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_SOLID = re.compile(rb"^[ \t]*solid\b", re.MULTILINE | re.IGNORECASE)
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
    return ForeignScene(objects=_checked([item], path), up="y")


def read_stl(path: Path, remarks: Remarks) -> ForeignScene:  # noqa: ARG001
    """The triangles of an STL file, in millimetres; several solids of a file of text are objects of their own."""
    data = read_foreign(path)
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and len(data) == 84 + _TRIANGLE.itemsize * count:
        solids = [(path.stem, np.frombuffer(data, _TRIANGLE, count, 84)["corners"].astype(np.float64).reshape(-1, 3))]
    elif data.lstrip()[:5].lower() == b"solid":
        solids = _solids(data, path)
    else:
        raise HyalineError(
            f"{path}: has {len(data):,} bytes for {count:,} triangles of 50 bytes; it is cut off, or not an STL file"
        )
    objects = [
        ForeignObject(
            name=name,
            positions=positions,
            faces=np.arange(len(positions)).reshape(-1, 3),
            normals=None,
            uv=None,
            material=PLAIN,
        )
        for name, positions in solids
    ]
    return ForeignScene(objects=_checked(objects, path), up="z", metres=0.001)


def _solids(data: bytes, path: Path) -> list[tuple[str, np.ndarray]]:
    """Names and corners of the solids in a file of text; one solid alone is called as the file is."""
    found = []
    for solid in _SOLID.split(data)[1:]:
        line, _, rest = solid.partition(b"\n")
        text = rest.lower()
        words = _VERTEX.findall(text)
        if len(words) != 3 * text.count(b"endfacet") or b"endsolid" not in text:
            raise HyalineError(f"{path}: ends in the middle of a facet; it is cut off, export it again")
        try:
            found.append((line.decode(errors="replace").strip() or path.stem, np.array(words, np.float64)))
        except ValueError as error:
            raise HyalineError(f"{path}: not an STL file that can be read ({error})") from None
    found = [(name, corners.reshape(-1, 3)) for name, corners in found if len(corners)]
    return found if len(found) > 1 else [(path.stem, corners) for _, corners in found]


def _checked(objects: list[ForeignObject], path: Path) -> tuple[ForeignObject, ...]:
    count = sum(len(item.faces) for item in objects)
    if not 0 < count <= MAX_TRIANGLES or len(objects) > MAX_SURFACES:
        raise HyalineError(
            f"{path}: holds {count:,} triangles in {len(objects):,} solids; expected 1 to {MAX_TRIANGLES:,} in at most "
            f"{MAX_SURFACES:,}"
        )
    if not all(np.isfinite(item.positions).all() for item in objects):
        raise HyalineError(f"{path}: holds numbers that are not finite; export it again")
    return tuple(objects)
