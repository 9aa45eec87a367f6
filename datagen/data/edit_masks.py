"""Edit masks: in which pixels of the test views an edit shows, and how.

    variants/NAME/edit-masks/SPLIT/0000.png     per pixel 0 elsewhere, 255 the objects, 128 their light
    variants/NAME/edit-masks/edit-masks.json    sealed, written first: SHA-256 of each picture

The objects: pixels whose centre ray meets a changed object, in the scene before or after, not behind anything opaque.
Their light: other pixels around which the truth differs between both scenes, by more than the noise of that difference
(shadows, caustics, mirror images, what glass bends, the edges that a centre ray may miss). Elsewhere: all others.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.paths import view_name
from datagen.data.png import read_png
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import EDIT_MASKS
from datagen.disk.records import entry, from_json
from datagen.disk.storage import check_files, load_sealed

FOLDER = "edit-masks"

ELSEWHERE, LIGHT, OBJECT = 0, 128, 255
"""Values of a mask's pixels."""


def edit_mask_files(edited: Dataset) -> dict[str, str]:
    """SHA-256 of each mask by path relative to the edited dataset."""
    return list_edit_masks(edited.root / FOLDER)


def list_edit_masks(root: Path) -> dict[str, str]:
    """SHA-256 of each picture that a folder of edit masks lists, by path relative to the folder above it."""
    path = root / EDIT_MASKS.head
    files = from_json(dict[str, str], load_sealed(path).get("files"), where=f"{path}: files")
    for file in files:
        if not re.fullmatch(rf"{FOLDER}/({'|'.join(TEST_SPLITS)})/[0-9]{{4,}}\.png", file):
            raise HyalineError(f"{path}: files: names {file!r}; expected {FOLDER}/SPLIT/0000.png")
    return files


def read_edit_mask(edited: Dataset, split: Split, view: int) -> UInt8[np.ndarray, "h w"]:
    """Where the edit shows in a view, verified: `OBJECT`, `LIGHT` or `ELSEWHERE`."""
    path = edit_mask_path(edited, split, view)
    file = path.relative_to(edited.root).as_posix()
    check_files(edited.root, {file: entry(edit_mask_files(edited), file, where=edited.root)})
    return read_png(path)[..., 0]


def edit_mask_path(edited: Dataset, split: Split, view: int) -> Path:
    return edited.root / FOLDER / split / f"{view_name(view)}.png"
