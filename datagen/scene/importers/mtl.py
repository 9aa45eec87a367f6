"""Materials of OBJ files. Source: the MTL specification of 1995, and its physically based extension of 2013."""

import math
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.names import find_file
from datagen.scene.importers.foreign import Factor, FactorImage, ForeignImage, ForeignMaterial, read_foreign
from datagen.scene.importers.remarks import Remarks
from datagen.scene.importers.text_numbers import floats, lines_of
from datagen.scene.values import Color

MAX_BYTES = 1 << 24
PBR_KEYS = ("pr", "pm", "ps", "pc")
"""Of the physically based extension. Where Blender writes them, it writes the weight of transmission as Tf."""
GLASS_MODELS = (4, 6, 7, 9)
"""Illumination models whose transparency is glass, by their names in the specification."""
MAX_OPAQUE = 0.9
"""Dissolve from which on a surface is opaque."""
USUAL_IOR = 1.5
OPTION_VALUES = {
    "-blendu": 1,
    "-blendv": 1,
    "-boost": 1,
    "-mm": 2,
    "-o": 3,
    "-s": 3,
    "-t": 3,
    "-texres": 1,
    "-clamp": 1,
    "-bm": 1,
    "-imfchan": 1,
    "-cc": 1,
}
"""How many words follow each option of an image."""
IGNORED = {
    "map_bump": "a bump map",
    "bump": "a bump map",
    "norm": "a normal map",
    "disp": "a displacement map",
    "map_ks": "a map of highlights",
    "map_ke": "a map of glow",
}

FACTOR_MAPS: dict[str, Factor] = {"map_pm": "metallic", "map_pr": "roughness"}

Entry = dict[str, list[str]]


def read_mtl(path: Path, remarks: Remarks) -> dict[str, ForeignMaterial]:
    """The materials of a file by name.

    Raises:
        HyalineError: a number is none, or an image leads out of the folder.
    """
    entries: dict[str, Entry] = {}
    entry: Entry = {}
    for line in lines_of(read_foreign(path, at_most=MAX_BYTES), where=str(path)):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] == "newmtl":
            entry = entries.setdefault(" ".join(words[1:]), {})
        else:
            entry[words[0].lower()] = words[1:]
    return {name: _material(name, entry, path, remarks) for name, entry in entries.items()}


def _material(name: str, entry: Entry, path: Path, remarks: Remarks) -> ForeignMaterial:
    where = f"{path}: material {name}"

    def number(key: str, default: float) -> float:
        return floats(entry[key], 1, where=f"{where}: {key}")[0] if key in entry else default

    for key, what in IGNORED.items():
        if key in entry:
            remarks.approximate(name, f"has {what}, which is left out")
    if "ke" in entry and max(_color(entry, "ke", (0, 0, 0), where=where)) > 0:
        remarks.approximate(name, "glows, which is left out")
    dissolve = number("d", 1.0 - number("tr", 0.0))
    model = number("illum", 2.0)
    filtered = _color(entry, "tf", (1.0, 1.0, 1.0), where=where)
    is_blenders = "tf" in entry and len(set(filtered)) == 1 and any(key in entry for key in PBR_KEYS)
    transmission = 1.0 if model in GLASS_MODELS or dissolve < MAX_OPAQUE else 0.0
    if is_blenders and transmission == 0:
        transmission = max(filtered)
    elif "tf" in entry and transmission == 0:
        remarks.note(name, "has a transmission filter (Tf), and is opaque by d and illum; --material makes it glass")
    is_glass = transmission >= 0.5
    ior = number("ni", USUAL_IOR)
    if is_glass and not 1.001 < ior < 10:
        remarks.approximate(name, f"is glass with an index of refraction of {ior:g}; drawn with {USUAL_IOR:g}")
    # Phong's exponent as a microfacet alpha, whose square root is the roughness.
    glossy = math.sqrt(math.sqrt(2 / (max(number("ns", 0.0), 0.0) + 2)))
    highlight = max(_color(entry, "ks", (1.0, 1.0, 1.0), where=where)) if number("ns", 0.0) > 0 and model > 1 else 0.0
    is_matt = not is_glass and highlight == 0 and not any(key in entry for key in PBR_KEYS)
    base_color = filtered if is_glass and not is_blenders else _color(entry, "kd", (0.7, 0.7, 0.7), where=where)
    opacity = None if is_glass else _image(name, entry, path, remarks, key="map_d")
    factor_images = tuple(
        FactorImage(factor=factor, image=image, channel=0)
        for key, factor in FACTOR_MAPS.items()
        if (image := _image(name, entry, path, remarks, key=key)) is not None
    )
    # An image stands in place of its number.
    numbers: dict[Factor, float] = {
        "metallic": number("pm", 0.0),
        "roughness": number("pr", 0.0 if is_glass else glossy),
        **{use.factor: 1.0 for use in factor_images},
    }
    return ForeignMaterial(
        name=name,
        base_color=base_color,
        image=None if is_glass and not is_blenders else _image(name, entry, path, remarks, key="map_kd"),
        alpha_mode="opaque" if opacity is None else "blend",
        opacity=opacity,
        metallic=min(max(numbers["metallic"], 0.0), 1.0),
        roughness=1.0 if is_matt else min(max(numbers["roughness"], 0.0), 1.0),
        transmission=transmission,
        factor_images=factor_images,
        ior=1.0 if is_matt else ior if 1.001 < ior < 10 else USUAL_IOR,
    )


def _color(entry: Entry, key: str, default: tuple[float, float, float], *, where: str) -> Color:
    if key not in entry:
        return default
    if entry[key][:1] in (["spectral"], ["xyz"]):
        raise HyalineError(f"{where}: {key} is {entry[key][0]}; expected three numbers, export it with RGB colours")
    words = entry[key] if len(entry[key]) > 1 else entry[key] * 3
    red, green, blue = (min(max(value, 0.0), 1.0) for value in floats(words, 3, where=f"{where}: {key}"))
    return red, green, blue


def file_named(words: list[str]) -> str:
    """The path that the words of a line name: with or without quotes around it, with either kind of slash."""
    name = " ".join(words)
    if len(name) > 1 and name[0] == name[-1] == '"':
        name = name[1:-1]
    return name.replace("\\", "/").removeprefix("./")


def _image(name: str, entry: Entry, path: Path, remarks: Remarks, *, key: str) -> ForeignImage | None:
    words = list(entry.get(key, []))
    if not words:
        return None
    while words and words[0] in OPTION_VALUES:
        remarks.approximate(name, f"has an image with the option {words[0]}, which is left out")
        words = words[1 + OPTION_VALUES[words[0]] :]
    found = find_file(path.parent, file_named(words), where=f"{path}: material {name}")
    if not found.exists():
        remarks.approximate(name, f"has an image that is not there ({found.name}); drawn without it")
        return None
    return ForeignImage(name=name, data=read_foreign(found))
