"""Plain formats: Wavefront OBJ with its MTL files, one surface for each object (or group) and material; PLY and STL.

Source: the OBJ and MTL specifications of 1995, and MTL's physically based extension of 2013.
"""

import io
import math
import re
from collections.abc import Mapping
from functools import partial
from itertools import pairwise, takewhile
from pathlib import Path

import numpy as np

from datagen.data.meshes import unfolded
from datagen.data.ply import MAX_PLY_BYTES, read_ply
from datagen.disk.errors import HyalineError, shown
from datagen.disk.storage import check_relative, find_file
from datagen.scene.images import opened_image
from datagen.scene.materials import Color
from hyaline_import.foreign import (
    PLAIN,
    ForeignImage,
    ForeignMaterial,
    ForeignObject,
    ForeignScene,
    clipped,
    clipped_color,
    read_foreign,
)
from hyaline_import.remarks import Remarks

WIDTHS = {"v": 3, "vt": 2, "vn": 3}
"""Numbers of a position, of uv and of a normal; a corner names them in this order."""
PBR_KEYS = ("pr", "pm", "ps", "pc")
"""Keys of the physically based extension. With them, Blender writes the weight of transmission as Tf."""
GLASS_MODELS = (4, 6, 7, 9)
"""Illumination models whose transparency is glass, by their names in the specification."""
MAX_OPAQUE = 0.9
"""Dissolve from which on a surface is opaque."""
USUAL_IOR = 1.5
CORNER = re.compile(r"(-?\d{1,11})(?:/(-?\d{1,11})?)?(?:/(-?\d{1,11})?)?", re.ASCII)
COMMENT = re.compile(r"^[ \t]*#.*$", re.MULTILINE)
NUMBER = re.compile(r"(?<=\s)[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?=\s)")
OPTIONS = re.compile(rf"(?:-[a-z]+\s+(?:(?:{NUMBER.pattern}|on|off|[rgbmlz])\s+)*)*")
"""The options before an image's name, with their values."""
IGNORED = (
    *("map_bump", "bump", "norm", "disp", "map_ks", "map_ke", "map_ns", "map_pm", "map_pr", "map_ps", "map_tr", "refl"),
    *("pc", "ps"),
)
"""Images and weights (of a clear coat and of sheen) that are left out."""
Entry = dict[str, list[str]]
"""The words of a material of an MTL by their key."""
Corner = tuple[int, ...]
"""Places of position, uv and normal in an OBJ; -1 for none."""
Numbers = dict[str, list[tuple[float, ...]]]


def read_obj(path: Path, remarks: Remarks, *, materials: Mapping[str, ForeignMaterial] | None = None) -> ForeignScene:
    """The surfaces of an OBJ file, with the materials of the MTL files that it names, or with these."""
    numbers: Numbers = {key: [] for key in WIDTHS}
    names = {"o": "", "g": "", "usemtl": ""}
    surfaces: dict[tuple[str, str], list[list[Corner]]] = {}
    has_materials, materials = materials is None, dict(materials or {})
    has_colors = False
    for number, line in enumerate(lines_of(read_foreign(path), where=str(path)), start=1):
        words = line.split()
        if not words:
            continue
        key, rest, where = words[0], words[1:], f"{path}: line {number}"
        if key in WIDTHS:
            # The v of a texture may be left out.
            words = [*rest[:2], "0"] if key == "vt" else rest
            numbers[key].append(floats(words, WIDTHS[key], where=where))
            has_colors |= key == "v" and len(words) >= 6
        elif key == "f":
            rest = [*takewhile(lambda word: not word.startswith("#"), rest)]
            if len(rest) < 3:
                raise HyalineError(f"{where}: is a face of {len(rest)} corners; expected at least 3")
            surface = surfaces.setdefault((names["o"] or names["g"], names["usemtl"]), [])
            surface.append([_corner(numbers, word, where=where) for word in rest])
        elif key in names:
            names[key] = " ".join(rest)
        elif key == "mtllib" and has_materials:
            materials |= _materials(path, rest, remarks, where=where)
        elif key in ("l", "p", "curv", "surf"):
            remarks.approximate(path.name, "has points, lines or curves, which are left out")
    if has_colors:
        remarks.approximate(path.name, "has colours at its vertices, which are left out")
    for material in dict.fromkeys(name for _, name in surfaces if has_materials and name and name not in materials):
        remarks.approximate(path.name, f"names the material {shown(material)}, which is not there; drawn grey")
    arrays = [np.array(listed, np.float64) for listed in numbers.values()]
    objects = [
        _object(name or material or path.stem, polygons, arrays, materials.get(material, PLAIN))
        for (name, material), polygons in surfaces.items()
    ]
    return ForeignScene(objects=tuple(objects), up="y")


def _materials(path: Path, words: list[str], remarks: Remarks, *, where: str) -> dict[str, ForeignMaterial]:
    """The materials of one file, whose name may have spaces, or of several."""
    names = [file_named(words)] if _find(path, file_named(words), where=where) else [file_named([w]) for w in words]
    found = [library for name in names if (library := _find(path, name, where=where)) is not None]
    if len(found) < max(len(names), 1):
        remarks.approximate(
            path.name, f"names {shown(file_named(words))}, which is not in its folder; drawn without these materials"
        )
    return {name: material for library in found for name, material in read_mtl(library, remarks).items()}


def _find(path: Path, name: str, *, where: str) -> Path | None:
    """The file of this name in the folder of another; None if it is not there, or the name is a path out of it."""
    try:
        check_relative(name, where=where)
    except HyalineError:  # Exporters write paths of the machine that they run on.
        return None
    found = find_file(path.parent, name, where=where)
    return found if found.exists() else None


def _corner(numbers: Numbers, word: str, *, where: str) -> Corner:
    """Places counted from 0; in the file they count from 1, or backwards from the last."""
    counts = [len(listed) for listed in numbers.values()]
    found = CORNER.fullmatch(word)
    places = [int(part or 0) for part in found.groups()] if found else [0]
    if not places[0] or any(not -count <= place <= count for place, count in zip(places, counts)):
        raise HyalineError(
            f"{where}: has the corner {shown(word)}; expected v, v/vt, v//vn or v/vt/vn, of {counts[0]} v, {counts[1]} "
            f"vt and {counts[2]} vn"
        )
    return tuple(place + count if place < 0 else place - 1 for place, count in zip(places, counts))


def _object(
    name: str, polygons: list[list[Corner]], arrays: list[np.ndarray], material: ForeignMaterial
) -> ForeignObject:
    """Polygons as triangles around their first corners; `unfolded` mends those of concave ones."""
    triangles = [(each[0], *pair) for each in polygons for pair in pairwise(each[1:])]
    corners = np.array(triangles, np.int64).reshape(-1, 3)
    used, index = np.unique(corners, axis=0, return_inverse=True)
    positions = arrays[0][used[:, 0]]
    return ForeignObject(
        name=name,
        positions=positions,
        faces=unfolded(positions, index.reshape(-1, 3), np.array([len(each) - 2 for each in polygons])),
        normals=arrays[2][used[:, 2]] if (used[:, 2] >= 0).all() else None,
        uv=arrays[1][used[:, 1]] if (used[:, 1] >= 0).all() else None,
        material=material,
    )


def read_mtl(path: Path, remarks: Remarks) -> dict[str, ForeignMaterial]:
    """The materials of a file by name."""
    entries: dict[str, Entry] = {}
    entry: Entry = {}
    for line in lines_of(read_foreign(path), where=str(path)):
        words = line.split()
        if not words:
            continue
        if words[0] == "newmtl":
            entry = entries.setdefault(" ".join(words[1:]), {})
        else:
            entry[words[0].lower()] = words[1:]
    return {name: _material(name, entry, path, remarks) for name, entry in entries.items()}


def _material(name: str, entry: Entry, path: Path, remarks: Remarks) -> ForeignMaterial:
    where = f"{path}: material {name}"

    def number(key: str, default: float) -> float:
        words = [word for word in entry.get(key, ()) if word != "-halo"]
        return floats(words, 1, where=f"{where}: {key}")[0] if key in entry else default

    def color(key: str, default: float) -> Color:
        words = entry.get(key, [str(default)])
        return clipped_color(floats(words if len(words) > 1 else words * 3, 3, where=f"{where}: {key}"))

    image_for = partial(_image, name, entry, path, remarks)
    model = int(number("illum", 2.0))
    transparency, ior = number("tr", 0.0), number("ni", USUAL_IOR)
    # A lone Tr 1 says nothing: MeshLab and OpenMVS write it for opaque scans.
    dissolve = number("d", 1 - transparency if transparency < 1 else 1.0)
    has_picture = bool(entry.get("map_kd"))
    filtered = color("tf", 1.0)
    is_weight = "tf" in entry and len(set(filtered)) == 1 and any(key in entry for key in PBR_KEYS)
    transmission = max(filtered) if is_weight else 0.0
    is_hinted = transparency > 0 or "ni" in entry or "glass" in name.lower()
    if _is_glass(dissolve, model, is_hinted=is_hinted, is_denied=has_picture or ior <= 1.001):
        transmission = 1.0
    is_glass = transmission >= 0.5
    if is_glass and not 1.001 < ior < 10:
        remarks.approximate(name, f"is glass with an index of refraction of {ior:g}; drawn with {USUAL_IOR:g}")
    for key in (*IGNORED, *["map_d"] * is_glass):
        if "".join(entry.get(key, [])).strip("0."):
            remarks.approximate(name, f"has {key}, which is left out")
    # Phong's exponent as a microfacet alpha, whose square root is the roughness.
    glossy = math.sqrt(math.sqrt(2 / (max(number("ns", 0.0), 0.0) + 2)))
    highlight = max(color("ks", 1.0)) if number("ns", 0.0) > 0 and model > 1 else 0.0
    is_matt = not is_glass and highlight == 0 and not any(key in entry for key in PBR_KEYS)
    image = image_for("map_kd")
    is_tinted = is_glass and not is_weight
    base_color = filtered if is_tinted else color("kd", 0.7)
    if max(base_color) == 0 and (is_tinted or image is not None):
        base_color = (1.0, 1.0, 1.0)  # Rhino writes Tf 0 for any glass, and Maya Kd 0 beside a picture.
    opacity = None if is_glass else image_for("map_d")
    return ForeignMaterial(
        emission=color("ke", 0.0),
        name=name,
        base_color=base_color,
        image=image,
        alpha_mode="opaque" if opacity is None else "blend",
        opacity=opacity,
        metallic=clipped(number("pm", 0.0)),
        roughness=1.0 if is_matt else clipped(number("pr", 0.0 if is_glass else glossy)),
        transmission=transmission,
        ior=1.0 if is_matt else ior if 1.001 < ior < 10 else USUAL_IOR,
    )


def _is_glass(dissolve: float, model: int, *, is_hinted: bool, is_denied: bool) -> bool:
    """True for glass, by the keys of which each means something else in the files of some program.

    | the file says | glass | reason |
    |---|---|---|
    | `d` below 0.9 or `Tr` above 0.1 | yes | Blender, 3ds Max, Rhino |
    | `illum` 4, 6, 7, 9 with `map_Kd` or `Ni` 1 | no | Maya writes `illum` 4 and `Ni` 1 for everything |
    | `illum` 4, 6, 7, 9 with `d` below 1, `Tr`, `Ni`, or a name of glass | yes | written by hand |
    | `illum` 4, 6, 7, 9 alone | no | Cinema 4D writes `illum` 7 for everything |
    | none of these | no, but one `Tf` beside `Pr`, `Pm`, `Ps` or `Pc` is Blender's weight of transmission | |
    """
    return dissolve < MAX_OPAQUE or (model in GLASS_MODELS and not is_denied and (dissolve < 1 or is_hinted))


def file_named(words: list[str]) -> str:
    """The path that the words of a line name: with or without quotes around it, with either kind of slash."""
    name = " ".join(words)
    if len(name) > 1 and name[0] == name[-1] == '"':
        name = name[1:-1]
    return name.replace("\\", "/").removeprefix("./")


def _image(name: str, entry: Entry, path: Path, remarks: Remarks, key: str) -> ForeignImage | None:
    if not (words := entry.get(key)):
        return None
    options = OPTIONS.match(" ".join(words))
    assert options is not None, "it matches nothing, too"
    if any(float(value) not in (0, 1) for value in NUMBER.findall(options[0])):
        remarks.approximate(name, f"has an image that options move or scale ({options[0].strip()}), which is left out")
    file = file_named(words[len(options[0].split()) :])
    found = _find(path, file, where=f"{path}: material {name}")
    if found is None:
        remarks.approximate(name, f"has the image {shown(file)}, which is not in its folder; drawn without it")
        return None
    image = ForeignImage(name=name, data=read_foreign(found))
    try:
        with opened_image(image.data, where=f"has the image {shown(file)}"):
            return image
    except HyalineError as error:
        remarks.approximate(name, f"{error}; drawn without it")
        return None


def floats(words: list[str], count: int, *, where: str) -> tuple[float, ...]:
    """The first `count` words as finite numbers."""
    try:
        values = tuple(map(float, words[:count]))
    except ValueError:
        values = ()
    if len(values) < count or not all(map(math.isfinite, values)):
        raise HyalineError(f"{where}: is {shown(' '.join(words))}; expected {count} finite numbers")
    return values


def lines_of(data: bytes, *, where: str) -> list[str]:
    """The lines of a text in UTF-8 or Latin-1, without comments; those that end in a backslash go on in the next."""
    if b"\0" in data:
        raise HyalineError(f"{where}: holds zero bytes; expected text")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    # A comment may end in a backslash, as folders of Windows do.
    text = COMMENT.sub("", text.replace("\r\n", "\n").replace("\r", "\n"))
    return text.replace("\\\n", " ").splitlines()


# PLY and STL


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
    )
    return ForeignScene(objects=(item,), up="y")


def read_stl(path: Path, remarks: Remarks) -> ForeignScene:  # noqa: ARG001
    """The triangles of an STL file, in millimetres; several solids of a file of text are objects of their own."""
    from trimesh.exchange.stl import load_stl

    data = read_foreign(path)
    try:
        found = load_stl(io.BytesIO(data))
    except Exception as error:  # It raises several kinds, and so does NumPy below it.
        raise HyalineError(f"{path}: not an STL file that can be read ({error}); export it again") from None
    solids = found.get("geometry", {path.stem: found})
    count, text = sum(len(solid["faces"]) for solid in solids.values()), data.lower()
    # trimesh passes over a solid of a text that does not end.
    is_whole = 3 * text.count(b"endfacet") == text.count(b"vertex") == 3 * count
    if len(data) != 84 + 50 * count and not is_whole:
        raise HyalineError(f"{path}: holds {count:,} triangles in {len(data):,} bytes; it is cut off, export it again")
    objects = [
        ForeignObject(name=name, positions=np.array(solid["vertices"], np.float64), faces=np.array(solid["faces"]))
        for name, solid in solids.items()
    ]
    return ForeignScene(objects=tuple(objects), up="z", metres=0.001)
