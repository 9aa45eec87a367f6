"""Variants of a dataset: more truth beside it, with the same scene or the same cameras; none of its bytes changes.

    variants/angles/        the splits extrapolating-10deg, -20deg, -40deg: cameras outside the training directions
    variants/x2/            views of the test splits, rendered twice as wide and high; x4 four times
    variants/stereo-60mm/   all splits, seen from 60 mm further right: the second pictures of rectified pairs
    variants/film-orbit/    the frames of a film, in the split interpolating; film-spline
    variants/remove-ball/   the test splits of the scene after an edit, with edit-masks/
    variants/no-glass/, variants/opaque-glass/   the twins: edits of all glass at once

Each has the layout of a dataset; its head names its parent (`config.Variant`). It uses the parent's scene, meshes and
proxies; an edit has its own. Predictions of a variant are in RUN/variants/NAME/.

Edit masks mark the pixels of the test views in which an edit shows:

    variants/NAME/edit-masks/SPLIT/0000.png     per pixel 0 elsewhere, 255 the objects, 128 their light
    variants/NAME/edit-masks/edit-masks.json    sealed, written first: SHA-256 of each picture

The objects: pixels whose centre ray meets a changed object, in the scene before or after, not behind anything opaque.
Their light: other pixels around which the truth differs between both scenes, by more than the noise of that difference
(shadows, caustics, mirror images, refracted light, edges that a centre ray may miss). Elsewhere: all others.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.images import decode_png
from datagen.data.paths import view_name
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import EDIT_MASKS
from datagen.disk.records import entry, from_json, load_sealed
from datagen.disk.storage import check_name, is_name, read_promised

VARIANTS_FOLDER = "variants"
"""In a dataset and in a run."""

ANGLES = "angles"

TWINS = ("no-glass", "opaque-glass")
"""Edits, and the names of their variants: all glass removed, or painted opaque."""


def variant_root(root: Path, name: str) -> Path:
    """The folder of a variant in a dataset, or of its predictions in a run."""
    return root / VARIANTS_FOLDER / check_name(name, where="variant")


def list_variants(root: Path) -> list[str]:
    """Names of all variants of the dataset in a folder, sorted."""
    heads = root.glob(f"{VARIANTS_FOLDER}/*/dataset.json")
    return sorted(head.parent.name for head in heads if head.is_file() and is_name(head.parent.name))


def has_variant(dataset: Dataset, name: str) -> bool:
    return (variant_root(dataset.root, name) / "dataset.json").is_file()


def open_variant(dataset: Dataset, name: str) -> Dataset:
    """A variant of a dataset."""
    if not has_variant(dataset, name):
        made = ", ".join(list_variants(dataset.root)) or "none"
        raise HyalineError(
            f"{variant_root(dataset.root, name)}: no such variant (there are: {made}); make it with `datagen add`"
        )
    return open_dataset(variant_root(dataset.root, name))


def evenly(count: int, total: int) -> list[int]:
    """`count` of `total` things, in order and as far apart as they can be."""
    return [(2 * place + 1) * total // (2 * count) for place in range(count)]


EDIT_MASKS_FOLDER = "edit-masks"

ELSEWHERE, LIGHT, OBJECT = 0, 128, 255
"""Values of a mask's pixels."""


def edit_mask_files(root: Path) -> dict[str, str]:
    """SHA-256 of each picture in a folder of edit masks, by path relative to it."""
    path = root / EDIT_MASKS.head
    files = from_json(dict[str, str], load_sealed(path).get("files"), where=f"{path}: files")
    for file in files:
        if not re.fullmatch(rf"{EDIT_MASKS_FOLDER}/({'|'.join(TEST_SPLITS)})/[0-9]{{4,}}\.png", file):
            raise HyalineError(f"{path}: files: names {file!r}; expected {EDIT_MASKS_FOLDER}/SPLIT/0000.png")
    return {file.removeprefix(f"{EDIT_MASKS_FOLDER}/"): promised for file, promised in files.items()}


def read_edit_mask(edited: Dataset, split: Split, view: int) -> UInt8[np.ndarray, "h w"]:
    """Where the edit shows in a view, verified: `OBJECT`, `LIGHT` or `ELSEWHERE`."""
    root, file = edited.root / EDIT_MASKS_FOLDER, f"{split}/{view_name(view)}.png"
    data = read_promised(root, file, entry(edit_mask_files(root), file, where=root))
    return np.asarray(decode_png(data, where=str(root / file)).convert("RGB"))[..., 0]
