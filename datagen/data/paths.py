"""Where the parts of a dataset lie, and where commands look for datasets."""

import re
import shlex
from pathlib import Path
from typing import Annotated, Literal, get_args

from datagen.disk.errors import HyalineError
from datagen.disk.storage import check_name

TRUTH = "truth"
"""The geometry of the scene's own meshes."""

FITTED = "fitted"
"""The geometry that `model fit` makes: glass as it was found, everything else true. Others are called `fitted-NAME`."""

MIXED = "mixed"
"""The geometry of a mixture of proxies. Others are called `mixed-NAME`."""

ProxyKind = Literal["box", "ellipsoid", "hull", "wrap"]
PROXY_KINDS: tuple[ProxyKind, ...] = get_args(ProxyKind)
Geometry = Annotated[str, lambda: (TRUTH, *PROXY_KINDS, MIXED, FITTED)]  # Help lists these; others begin with one.


def is_fitted(geometry: str) -> bool:
    return geometry.partition("-")[0] == FITTED


def follows_light(geometry: str) -> bool:
    """True if light paths can be traced through a geometry: the truth and fits, not coarse proxies."""
    return geometry == TRUTH or is_fitted(geometry)


def view_name(view: int) -> str:
    return f"{view:04d}"


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


BUILD = "datagen build glass_table"
"""An example of the command that makes a dataset."""

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
        raise HyalineError(f"{root}: no dataset there; make one with `{BUILD}`")
    raise HyalineError(f"{root}: holds {len(found)} datasets; name one of {', '.join(map(str, found))}")


def list_datasets(root: Path = DATA_ROOT) -> list[Path]:
    """Every dataset folder under `root`, sorted."""
    return sorted(path.parent for path in root.glob("*/dataset.json"))


def train_command(root: Path, geometry: str = TRUTH) -> str:
    """An example of the command after peeling a geometry."""
    words = ["model", "train", "paper", str(root)]
    return shlex.join([*words, *([] if geometry == TRUTH else ["--geometry", geometry])])


def where_datasets_are() -> str:
    """What to do about a folder without a dataset."""
    there = ", ".join(shlex.quote(str(place)) for place in list_datasets())
    return f"there is {there}" if there else f"make one with `{BUILD}`"
