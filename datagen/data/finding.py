"""Finding datasets: by name, by folder, or the only one there; and what to type next, with and without one."""

import difflib
import os
import shlex
from pathlib import Path

from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.disk.homes import HEADS, home_of, mend_command

DATA_ROOT = Path("data")
"""Where commands put and look for datasets, relative to the working directory."""

BUILT_IN_SCENES = ("glass_table", "vitrine", "plant_shelf", "drinks", "prism_bench", "pool")
"""Names of the scenes that code makes: the files in datagen/scene/builtin."""


def find_dataset(given: str | None, root: Path = DATA_ROOT) -> Path:
    """The dataset that `--dataset` means: a folder, a name under `root`, or the only one there.

    Raises:
        HyalineError: none or several fit.
    """
    if given is not None:
        named = Path(given)
        is_there = any((named / path).is_file() for path in ("dataset.json", f"{HEADS}/dataset.json"))
        return named if is_there or len(named.parts) > 1 else root / given
    found = list_datasets(root)
    if len(found) == 1:
        return found[0]
    if not found:
        place = root if root == DATA_ROOT else root / "glass_table"
        raise HyalineError(f"{root}: no dataset there; make one with `{build_command(place)}`")
    raise HyalineError(f"{root}: holds {len(found)} datasets; choose one with --dataset: {', '.join(map(str, found))}")


def list_datasets(root: Path = DATA_ROOT) -> list[Path]:
    """Every dataset folder under `root`, sorted."""
    return sorted(path.parent for path in root.glob("*/dataset.json"))


def build_command(root: Path = DATA_ROOT) -> str:
    """The command that makes a dataset of this folder, or of the first built-in scene that is not built in it yet."""
    if root.name in BUILT_IN_SCENES or root != DATA_ROOT:
        scene = root.name if root.name in BUILT_IN_SCENES else "glass_table"
    else:
        scene = next((name for name in BUILT_IN_SCENES if not (root / name).exists()), "glass_table")
        root = root / scene
    return shlex.join(
        ["datagen", "build", "--scene", scene, *([] if root == DATA_ROOT / scene else ["--out", str(root)])]
    )


def train_command(root: Path, geometry: str = TRUTH) -> str:
    """An example of what comes after layers of a geometry."""
    words = ["model", "train", "paper", "--dataset", str(root)]
    return shlex.join([*words, *([] if geometry == TRUTH else ["--geometry", geometry])])


def render_command(variant: str) -> str:
    """An example of what comes after a variant: a trained run draws it."""
    return shlex.join(["model", "render", "--run", "RUN", "--variant", variant])


def where_datasets_are(root: Path) -> str:
    """The way out for somebody who named a folder without a dataset."""
    if (root / HEADS / "dataset.json").is_file():
        return f"mend it with `{mend_command(root / 'dataset.json')}`"
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
