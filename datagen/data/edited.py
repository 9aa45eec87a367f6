"""Owns where the datasets of edited scenes lie: beside their base, in edits/NAME, one a scene."""

import shlex
from pathlib import Path

from datagen.data.dataset import Dataset, open_dataset
from datagen.disk.errors import HyalineError
from datagen.disk.names import check_name, is_name


def edit_root(base: Dataset, name: str) -> Path:
    """Where the dataset of an edited scene lies."""
    return base.root / "edits" / check_name(name, where="edit")


def list_edits(base: Dataset) -> list[str]:
    """Names of all edits that were built for a dataset."""
    return sorted(path.parent.name for path in base.root.glob("edits/*/dataset.json") if is_name(path.parent.name))


def open_edit(base: Dataset, name: str) -> Dataset:
    """The dataset of an edited scene.

    Raises:
        HyalineError: it was not built, or for another version of the dataset.
    """
    root = edit_root(base, name)
    if not (root / "dataset.json").is_file():
        made = ", ".join(list_edits(base)) or "none"
        raise HyalineError(
            f"{root}: no such edit (there are: {made}); make one with "
            f"`datagen build --dataset {shlex.quote(str(base.root))} --edit EDIT`"
        )
    edited = open_dataset(root)
    if edited.edit is None or edited.edit.base != base.seal:
        raise HyalineError(f"{root}: was made for another version of {base.root}; build it again with --overwrite")
    return edited
