"""Where the parts of a dataset lie, where commands look for datasets, and which command to suggest next."""

import difflib
import os
import re
import shlex
from pathlib import Path
from typing import Literal, get_args

from datagen.data.config import Split
from datagen.data.metadata import Imported
from datagen.disk.errors import HyalineError
from datagen.disk.names import check_name
from datagen.disk.storage import home_of

TRUTH = "truth"
"""The geometry of the scene's own meshes."""

FITTED = "fitted"
"""The geometry that `model fit` makes: glass as it was found, everything else true. Others are called `fitted-NAME`."""

MIXED = "mixed"
"""The geometry of a mixture of proxies. Others are called `mixed-NAME`."""

ProxyKind = Literal["box", "ellipsoid", "hull", "lowpoly", "wrap", "blocks", "noise"]
PROXY_KINDS: tuple[ProxyKind, ...] = get_args(ProxyKind)
"""All kinds of proxies, which name geometries. `noise` moves the vertices of the true meshes
(proxies/meshing/noise.py), and its geometry ends in the amount, as in noise-0.01."""


def is_fitted(geometry: str) -> bool:
    return geometry.partition("-")[0] == FITTED


def follows_light(geometry: str) -> bool:
    """True if light paths can be traced through a geometry: the truth and fits, not coarse proxies."""
    return geometry == TRUTH or is_fitted(geometry)


def view_name(view: int) -> str:
    return f"{view:04d}"


def image_path(root: Path, split: Split, view: int) -> Path:
    """The 8-bit sRGB picture; the linear one is beside it, with the ending `.exr`."""
    return root / "images" / split / f"{view_name(view)}.png"


def record_path(root: Path, split: Split, view: int) -> Path:
    return root / "records" / split / f"{view_name(view)}.json"


def geometry_root(root: Path, geometry: str) -> Path:
    """The folder of a geometry's meshes and layers: the dataset for the truth, else its proxy folder."""
    return root if geometry == TRUTH else root / "proxies" / check_name(geometry, where="geometry")


def layers_root(root: Path, geometry: str) -> Path:
    """The folder of a geometry's layers."""
    return geometry_root(root, geometry) / "layers" / "straight"


DATA_ROOT = Path("data")
"""Folder of datasets, relative to the working directory."""

BUILT_IN_SCENES = {
    "glass_table": "A green-tinted glass table with solid glassware, seen against a slatted chair and a warm room",
    "vitrine": "Opaque sculptures of many colours behind the thin panes of a display case",
    "plant_shelf": "Two leafy plants around a shelf with a glass vase, a bell jar, books and pots",
    "drinks": "Tinted drinks in glasses, with ice and a straw: media that touch each other, on a table in a room",
    "prism_bench": "Prisms, a lens, cut crystal and frosted glass that split a hard beam into colours, in the dark",
    "pool": "Rippled water in a tiled basin in the sun: caustics below, clear and frosted glass standing in it",
}
"""The built-in scenes, which datagen/scene/builtin makes, and a line about each."""


HIDDEN = re.compile(r"hidden-[0-9]+")
"""Names of scenes that `hyaline-bench hide` publishes: grey, and without the pictures of their test views."""


def find_dataset(given: str | None, root: Path = DATA_ROOT) -> Path:
    """The dataset that a command's first word means: a folder, a name under `root`, or the only one there."""
    if given is not None:
        named = Path(given)
        return named if (named / "dataset.json").is_file() or len(named.parts) > 1 else root / given
    found = list_datasets(root)
    if len(found) == 1:
        return found[0]
    if not found:
        place = root if root == DATA_ROOT else root / "glass_table"
        raise HyalineError(f"{root}: no dataset there; make one with `{build_command(place)}`")
    raise HyalineError(f"{root}: holds {len(found)} datasets; name one of {', '.join(map(str, found))}")


def list_datasets(root: Path = DATA_ROOT) -> list[Path]:
    """Every dataset folder under `root`, sorted."""
    return sorted(path.parent for path in root.glob("*/dataset.json"))


def build_command(root: Path = DATA_ROOT) -> str:
    """The command that builds a dataset in this folder, or the first built-in scene that is missing in it."""
    if root.name in BUILT_IN_SCENES or root != DATA_ROOT:
        scene = root.name if root.name in BUILT_IN_SCENES else "glass_table"
    else:
        scene = next((name for name in BUILT_IN_SCENES if not (root / name).exists()), "glass_table")
        root = root / scene
    return shlex.join(
        ["datagen", "build", "--scene", scene, *([] if root == DATA_ROOT / scene else ["--out", str(root)])]
    )


def train_command(root: Path, geometry: str = TRUTH, imported: Imported | None = None) -> str:
    """An example of the command after peeling a geometry; the glass of a capture is fitted first."""
    if imported is not None and imported.has_objects and geometry == TRUTH:
        return shlex.join(["model", "fit", str(root)])
    words = ["model", "train", "paper", str(root)]
    return shlex.join([*words, *([] if geometry == TRUTH else ["--geometry", geometry])])


def predict_command(variant: str) -> str:
    """An example of the command after building a variant: a trained run predicts it."""
    return shlex.join(["model", "predict", "RUN", "--variant", variant])


def where_datasets_are(root: Path) -> str:
    """What to do about a folder without a dataset."""
    places = list_datasets()
    known = ", ".join(shlex.quote(str(place)) for place in places)
    there = f"there is {known}" if known else ""
    is_free = not os.path.lexists(root) or (root.is_dir() and not any(root.iterdir()))
    if not is_free or home_of(root) != root:
        return there or f"make one elsewhere with `{build_command()}`"
    make = "; or ".join(filter(None, [f"make one with `{build_command(root)}`", there]))
    if near := difflib.get_close_matches(root.name, [place.name for place in places], n=1):
        return f"did you mean {shlex.quote(near[0])}? Else {make}"
    if root.name not in BUILT_IN_SCENES and (near := difflib.get_close_matches(root.name, BUILT_IN_SCENES, n=1)):
        return f"did you mean {near[0]}? Make that with `{build_command(root.with_name(near[0]))}`; else {make}"
    return make
