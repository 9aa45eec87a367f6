"""Variants of a dataset: more truth beside it, with the same scene or the same cameras; none of its bytes changes.

    variants/angles/        the splits extrapolating-10deg, -20deg, -40deg: cameras outside of what training covers
    variants/x2/            views of the test splits, rendered twice as wide and high; x4 the same four times
    variants/remove-ball/   the test splits of the scene after an edit, with edit-masks/ (data/edit_masks.py)
    variants/no-glass/, variants/opaque-glass/   the twins: such edits of all glass at once

Each is laid out like a dataset; its head says which dataset it belongs to (`dataset.Variant`). Scene, meshes and
proxies are the parent's, but for an edit, which has its own. Predictions of a variant lie in RUN/variants/NAME/.
"""

import shlex
from pathlib import Path

from datagen.data.config import Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.disk.errors import HyalineError
from datagen.disk.names import check_name, is_name

FOLDER = "variants"
"""In a dataset and in a run."""

ANGLES = "angles"

TWINS = ("no-glass", "opaque-glass")
"""Edits, and the variants that they make: all glass gone, and painted opaque."""


def variant_root(root: Path, name: str) -> Path:
    """Where a variant of the dataset in a folder lies, or what a run drew of it."""
    return root / FOLDER / check_name(name, where="variant")


def scale_name(scale: int) -> str:
    """The variant with pictures so many times as wide and high."""
    return f"x{scale}"


def list_variants(root: Path) -> list[str]:
    """Names of all variants of the dataset in a folder, sorted."""
    heads = [path for path in root.glob(f"{FOLDER}/*/dataset.json") if path.is_file()]
    return sorted(path.parent.name for path in heads if is_name(path.parent.name))


def has_variant(dataset: Dataset, name: str) -> bool:
    return (variant_root(dataset.root, name) / "dataset.json").is_file()


def open_variant(dataset: Dataset, name: str) -> Dataset:
    """A variant of a dataset.

    Raises:
        HyalineError: not built, damaged, or of a dataset that stood there before.
    """
    if not has_variant(dataset, name):
        made = ", ".join(list_variants(dataset.root)) or "none"
        raise HyalineError(
            f"{variant_root(dataset.root, name)}: no such variant (there are: {made}); make it with "
            f"`{variant_command(dataset, name)}`"
        )
    return open_dataset(variant_root(dataset.root, name))


def is_larger(variant: Dataset) -> bool:
    """True for a variant of larger pictures."""
    return variant.parent is not None and variant.config.resolution != variant.parent.config.resolution


def evenly(count: int, total: int) -> list[int]:
    """`count` of `total` things, in order and as far apart as they can be."""
    return [(2 * place + 1) * total // (2 * count) for place in range(count)]


def parent_views(variant: Dataset, split: Split) -> list[int]:
    """Which views of the parent's split those of a variant with larger pictures are."""
    assert variant.parent is not None
    return evenly(variant.config.split(split).views, variant.parent.config.split(split).views)


def variant_command(dataset: Dataset, name: str, variant: Dataset | None = None) -> str:
    """The command that makes a variant: as its head records it, or as far as its name tells."""
    if name == ANGLES:
        flags = ["--angle-splits"]
    elif name in TWINS:
        flags = ["--twins"]
    elif name[:1] == "x" and name[1:].isdecimal():
        flags = ["--super-resolution", name[1:]]
        if variant is not None and (views := variant.num_views["interpolating"]) != dataset.num_views["interpolating"]:
            flags += ["--super-resolution-views", str(views)]
    else:
        edits = ("EDIT",) if variant is None or variant.edit is None else variant.edit.edits
        flags = [word for edit in edits for word in ("--edit", edit)]
    return shlex.join(["datagen", "build", "--dataset", str(dataset.root), *flags])
