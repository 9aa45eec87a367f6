"""Wavefront OBJ files: one surface for each object (or group) and material."""

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from datagen.disk.errors import HyalineError
from datagen.disk.names import find_file
from datagen.disk.records import shown
from datagen.scene.importers.foreign import (
    MAX_SURFACES,
    MAX_TRIANGLES,
    ForeignMaterial,
    ForeignObject,
    ForeignScene,
    read_foreign,
)
from datagen.scene.importers.mtl import file_named, read_mtl
from datagen.scene.importers.remarks import Remarks
from datagen.scene.importers.text_numbers import floats, lines_of

MAX_BYTES = 1 << 28
MAX_CORNERS = 10_000
"""Of one polygon."""
PLAIN = ForeignMaterial(name="default", base_color=(0.8, 0.8, 0.8), roughness=1.0, ior=1.0)
"""Of a surface that names no material: Blender's grey. (glTF would have it rough metal, which nobody means.)"""

Corner = tuple[int, int, int]
"""Places of position, uv and normal; -1 for none."""


@dataclass
class _Text:
    """What was read of a file so far."""

    positions: list[tuple[float, ...]] = field(default_factory=list)
    uv: list[tuple[float, ...]] = field(default_factory=list)
    normals: list[tuple[float, ...]] = field(default_factory=list)
    faces: dict[tuple[str, str], list[tuple[Corner, Corner, Corner]]] = field(default_factory=dict)
    """Triangles by the names of their object and of their material."""
    materials: dict[str, ForeignMaterial] = field(default_factory=dict)
    num_faces: int = 0


def read_obj(path: Path, remarks: Remarks, *, has_materials: bool = True) -> ForeignScene:
    """The surfaces of an OBJ file, with the materials of the MTL files that it names.

    Raises:
        HyalineError: it is no such file, or names vertices that are not there.
    """
    text = _Text()
    name, group, material = "", "", ""
    data = read_foreign(path, at_most=MAX_BYTES)
    for number, line in enumerate(lines_of(data, where=str(path)), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        key, rest, where = words[0], words[1:], f"{path}: line {number}"
        if key == "v":
            text.positions.append(floats(rest, 3, where=where))
        elif key == "vt":
            text.uv.append(floats([*rest[:2], "0"], 2, where=where))
        elif key == "vn":
            text.normals.append(floats(rest, 3, where=where))
        elif key == "f":
            _add_face(text, (name or group, material), rest, where=where)
        elif key == "o":
            name = " ".join(rest)
        elif key == "g":
            group = " ".join(rest)
        elif key == "usemtl":
            material = " ".join(rest)
        elif key == "mtllib" and has_materials:
            _add_materials(text, path, file_named(rest), remarks, where=where)
        elif key in ("l", "p", "curv", "surf"):
            remarks.approximate(path.name, "has points, lines or curves, which are left out")
    if not text.faces:
        raise HyalineError(f"{path}: holds no faces; expected an OBJ file with a mesh")
    return ForeignScene(objects=tuple(_objects(text, path, remarks)), up="y")


def _add_materials(text: _Text, path: Path, name: str, remarks: Remarks, *, where: str) -> None:
    found = find_file(path.parent, name, where=where)
    if not found.exists():
        remarks.approximate(path.name, f"names {shown(name)}, which is not there; drawn without its materials")
        return
    text.materials |= read_mtl(found, remarks)


def _add_face(text: _Text, place: tuple[str, str], words: list[str], *, where: str) -> None:
    """A polygon as triangles around its first corner."""
    if not 3 <= len(words) <= MAX_CORNERS:
        raise HyalineError(f"{where}: is a face of {len(words)} corners; expected 3 to {MAX_CORNERS}")
    corners = [_corner(text, word, where=where) for word in words]
    if place not in text.faces and len(text.faces) >= MAX_SURFACES:
        raise HyalineError(f"{where}: begins surface {MAX_SURFACES + 1:,}; expected at most {MAX_SURFACES:,}")
    text.num_faces += len(corners) - 2
    if text.num_faces > MAX_TRIANGLES:
        raise HyalineError(f"{where}: is triangle {text.num_faces:,}; expected at most {MAX_TRIANGLES:,}")
    triangles = pairwise(corners[1:])
    text.faces.setdefault(place, []).extend((corners[0], second, third) for second, third in triangles)


def _corner(text: _Text, word: str, *, where: str) -> Corner:
    parts = word.split("/")
    if len(parts) > 3 or not parts[0]:
        raise HyalineError(f"{where}: has the corner {shown(word)}; expected v, v/vt, v//vn or v/vt/vn")
    parts += [""] * (3 - len(parts))
    place, uv, normal = (
        _index(part, len(listed), where=where)
        for part, listed in zip(parts, (text.positions, text.uv, text.normals), strict=True)
    )
    return place, uv, normal


def _index(word: str, count: int, *, where: str) -> int:
    """A place counted from 0; in the file they count from 1, or backwards from the last."""
    if not word:
        return -1
    try:
        index = int(word) if len(word) < 12 else 0
    except ValueError:
        index = 0
    if index == 0 or not -count <= index <= count:
        raise HyalineError(f"{where}: names {shown(word)} of {count}; expected 1 to {count}, or -{count} to -1")
    return index - 1 if index > 0 else count + index


def _objects(text: _Text, path: Path, remarks: Remarks) -> list[ForeignObject]:
    objects = []
    arrays = [np.array(listed, np.float64) for listed in (text.positions, text.uv, text.normals)]
    for (name, material), faces in text.faces.items():
        if material and material not in text.materials:
            remarks.approximate(path.name, f"names the material {shown(material)}, which is not there; drawn grey")
        corners = np.array(faces, np.int64).reshape(-1, 3)
        used, index = np.unique(corners, axis=0, return_inverse=True)
        has_uv, has_normals = (used[:, 1] >= 0).all(), (used[:, 2] >= 0).all()
        objects.append(
            ForeignObject(
                name=name or material or path.stem,
                positions=arrays[0][used[:, 0]],
                faces=index.reshape(-1, 3),
                normals=arrays[2][used[:, 2]] if has_normals else None,
                uv=arrays[1][used[:, 1]] if has_uv else None,
                material=text.materials.get(material, PLAIN),
            )
        )
    return objects
