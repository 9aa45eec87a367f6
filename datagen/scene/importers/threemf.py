"""3MF files: the objects of a print job, with their colours. Source: 3MF Core Specification 1.3."""

import io
import xml.parsers.expat
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from datagen.data.license import MAX_LENGTH, license_line
from datagen.disk.errors import HyalineError
from datagen.disk.records import shown
from datagen.scene.importers.foreign import (
    MAX_SURFACES,
    MAX_TRIANGLES,
    PLAIN,
    ForeignMaterial,
    ForeignObject,
    ForeignScene,
    elementwise,
    read_foreign,
)
from datagen.scene.importers.meshes.obj import floats
from datagen.scene.importers.remarks import Remarks

RIGHTS = ("LicenseTerms", "Copyright")
METRES = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}
MAX_DEPTH = 16
"""Components within components."""

Attributes = dict[str, str]


@dataclass
class _Object:
    name: str
    material: tuple[str, str]
    positions: list[tuple[float, ...]] = field(default_factory=list)
    faces: list[tuple[int, int, int]] = field(default_factory=list)
    components: list[tuple[str, np.ndarray]] = field(default_factory=list)


@dataclass
class _Model:
    metres: float = 1e-3
    rights: list[str] = field(default_factory=list)
    """What its metadata says of licence and copyright."""
    objects: dict[str, _Object] = field(default_factory=dict)
    items: list[tuple[str, np.ndarray]] = field(default_factory=list)
    colors: dict[str, list[ForeignMaterial]] = field(default_factory=dict)


def read_3mf(path: Path, remarks: Remarks) -> ForeignScene:
    """The objects that a 3MF file would print.

    Raises:
        HyalineError: it is no such file, or damaged.
    """
    model = _parse(_model_text(path), path)
    objects: list[ForeignObject] = []
    triangles = visits = 0
    waiting = [(name, matrix, 0) for name, matrix in reversed(model.items)]
    while waiting:
        name, matrix, depth = waiting.pop()
        if name not in model.objects or depth > MAX_DEPTH:
            raise HyalineError(f"{path}: places object {shown(name)}, which is not there or holds itself")
        item = model.objects[name]
        waiting += [(part, matrix @ local, depth + 1) for part, local in reversed(item.components)]
        triangles, visits = triangles + len(item.faces), visits + 1
        if triangles > MAX_TRIANGLES or visits > MAX_SURFACES:
            raise HyalineError(
                f"{path}: places more than {MAX_TRIANGLES:,} triangles or {MAX_SURFACES:,} objects; expected fewer"
            )
        if item.faces:
            objects.append(_placed(item, matrix, model, path))
    if not objects:
        raise HyalineError(f"{path}: builds no object; expected a 3MF file with a mesh")
    if any(name.startswith("texture") for name in model.colors):
        remarks.approximate(path.name, "has textures, which are left out")
    return ForeignScene(objects=tuple(objects), up="z", metres=model.metres, license=license_line(*model.rights))


def _model_text(path: Path) -> bytes:
    """The XML of the model in the archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(read_foreign(path))) as archive:
            names = [info for info in archive.infolist() if info.filename.lower().endswith(".model")]
            names.sort(key=lambda info: (info.filename != "3D/3dmodel.model", info.filename))
            if not names:
                raise HyalineError(f"{path}: holds no model; expected a 3MF file")
            return archive.read(names[0])
    # zipfile answers a broken archive with many kinds of exception (BadZipFile, zlib.error, NotImplementedError, ...).
    except (HyalineError, MemoryError):
        raise
    except Exception as error:
        raise HyalineError(f"{path}: not a 3MF file that can be read ({type(error).__name__}: {error})") from error


def _parse(text: bytes, path: Path) -> _Model:
    model = _Model()
    current: list[_Object] = []
    group = [""]
    is_rights = [False]

    def begin(tag: str, attributes: Attributes) -> None:
        tag = tag.rpartition(":")[2]
        where = f"{path}: {tag}"
        is_rights[0] = tag == "metadata" and attributes.get("name") in RIGHTS
        if is_rights[0]:
            model.rights.append("")
        elif tag == "model":
            model.metres = METRES.get(attributes.get("unit", "millimeter"), 1e-3)
        elif tag == "basematerials":
            group[0] = attributes.get("id", "")
            model.colors[group[0]] = []
        elif tag == "base" and group[0] in model.colors:
            model.colors[group[0]].append(_material(attributes, where))
        elif tag == "object":
            material = (attributes.get("pid", ""), attributes.get("pindex", "0"))
            current[:] = [
                _Object(name=attributes.get("name", "") or f"object_{attributes.get('id')}", material=material)
            ]
            model.objects[attributes.get("id", "")] = current[0]
        elif tag == "vertex" and current:
            current[0].positions.append(floats([attributes.get(key, "") for key in "xyz"], 3, where=where))
        elif tag == "triangle" and current:
            current[0].faces.append(_triangle(attributes, len(current[0].positions), where))
        elif tag in ("component", "item"):
            if any(key.rpartition(":")[2] == "path" for key in attributes):
                raise HyalineError(f"{where}: lies in another part of the archive; export it as one model")
            placed = (attributes.get("objectid", ""), _matrix(attributes.get("transform"), where))
            (current[0].components if tag == "component" and current else model.items).append(placed)

    def read(text: str) -> None:
        if is_rights[0] and len(model.rights[-1]) < MAX_LENGTH:
            model.rights[-1] += text

    def end(tag: str) -> None:
        is_rights[0] = False
        if tag.rpartition(":")[2] == "object":
            current.clear()

    def refuse(*_: object) -> None:
        raise HyalineError(f"{path}: declares a document type; expected none in a 3MF file")

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = begin, end, read
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(text, True)
    except (xml.parsers.expat.ExpatError, ValueError, LookupError) as error:  # The latter two of its encoding.
        raise HyalineError(f"{path}: not XML that can be read ({error}); export it again") from None
    return model


def _triangle(attributes: Attributes, count: int, where: str) -> tuple[int, int, int]:
    words = [attributes.get(key, "") for key in ("v1", "v2", "v3")]
    if not all(_is_index(word) and int(word) < count for word in words):
        raise HyalineError(f"{where}: names vertices {shown(words)}; expected 0 to {count - 1}")
    a, b, c = map(int, words)
    return a, b, c


def _is_index(word: str) -> bool:
    return word.isascii() and word.isdigit() and len(word) < 10


def _matrix(text: str | None, where: str) -> np.ndarray:
    """Of twelve numbers, column by column, the last three the offset."""
    matrix = np.eye(4)
    if text is not None:
        matrix[:3] = np.array(floats(text.split(), 12, where=where)).reshape(4, 3).T
    return matrix


def _material(attributes: Attributes, where: str) -> ForeignMaterial:
    text = attributes.get("displaycolor", "#B2B2B2").lstrip("#")
    try:
        encoded = [int(text[at : at + 2], 16) / 255 for at in (0, 2, 4)]
        alpha = int(text[6:8], 16) / 255 if len(text) == 8 else 1.0
    except ValueError:
        raise HyalineError(f"{where}: has the colour {shown(text)}; expected #RRGGBB or #RRGGBBAA") from None
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in encoded)
    name = attributes.get("name", "material")
    return ForeignMaterial(
        name=name, base_color=(red, green, blue), alpha=alpha, alpha_mode="blend" if alpha < 1 else "opaque"
    )


def _placed(item: _Object, matrix: np.ndarray, model: _Model, path: Path) -> ForeignObject:
    group, index = item.material
    listed = model.colors.get(group, [])
    material = listed[int(index)] if _is_index(index) and int(index) < len(listed) else PLAIN
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if not 1e-30 < abs(determinant) < 1e30:
        raise HyalineError(f"{path}: flattens {item.name} to nothing; export it again")
    faces = np.array(item.faces, np.int64)
    return ForeignObject(
        name=item.name,
        positions=elementwise(np.array(item.positions, np.float64), matrix[:3, :3], matrix[:3, 3]),
        faces=faces[:, ::-1] if determinant < 0 else faces,
        normals=None,
        uv=None,
        material=material,
    )
