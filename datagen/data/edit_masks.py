"""Owns an edit's footprints: in which pixels of the test views it shows, and how.

    edits/NAME/footprints/SPLIT/0000.png     per pixel 0 elsewhere, 255 the objects, 128 their light
    edits/NAME/footprints/footprints.json    sealed, written first: SHA-256 of each picture

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
from datagen.disk.ownership import FOOTPRINTS
from datagen.disk.promises import check_files
from datagen.disk.records import entry, from_json
from datagen.disk.storage import load_sealed

ELSEWHERE, LIGHT, OBJECT = 0, 128, 255
"""Values of a footprint's pixels."""


def footprint_files(edited: Dataset) -> dict[str, str]:
    """SHA-256 of each footprint by path relative to the edited dataset."""
    return list_footprints(edited.root / "footprints")


def list_footprints(root: Path) -> dict[str, str]:
    """SHA-256 of each picture that a folder of footprints lists, by path relative to the folder above it."""
    path = root / FOOTPRINTS.head
    files = from_json(dict[str, str], load_sealed(path).get("files"), where=f"{path}: files")
    for file in files:
        if not re.fullmatch(rf"footprints/({'|'.join(TEST_SPLITS)})/[0-9]{{4,}}\.png", file):
            raise HyalineError(f"{path}: files: names {file!r}; expected footprints/SPLIT/0000.png")
    return files


def read_footprint(edited: Dataset, split: Split, view: int) -> UInt8[np.ndarray, "h w"]:
    """Where the edit shows in a view, verified: `OBJECT`, `LIGHT` or `ELSEWHERE`."""
    path = footprint_path(edited, split, view)
    file = path.relative_to(edited.root).as_posix()
    check_files(edited.root, {file: entry(footprint_files(edited), file, where=edited.root)})
    return read_png(path)[..., 0]


def footprint_path(edited: Dataset, split: Split, view: int) -> Path:
    return edited.root / "footprints" / split / f"{view_name(view)}.png"
