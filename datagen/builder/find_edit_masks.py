"""Where an edit shows in the pictures of its dataset: found from both truths, pixel by pixel."""

import contextlib

import numpy as np
from jaxtyping import Bool, Float, UInt8

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.images import png_bytes, srgb_from_linear
from datagen.data.variants import EDIT_MASKS_FOLDER, ELSEWHERE, LIGHT, OBJECT, edit_mask_files, edit_mask_path
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import EDIT_MASKS, begin, holding, is_ours
from datagen.disk.records import Json
from datagen.disk.storage import check_files, commit_same, commit_sealed, load_sealed, seal_bytes, sha256

SIGMAS = 3.0
"""Least difference that counts, in standard deviations of its noise."""


LEAST = 0.5 / 255
"""And when it is at least half a step of an 8-bit picture."""


WINDOW = 5
"""Pixels a side over which difference and noise are averaged: light spreads, the noise of single pixels does not."""


def write_edit_masks(base: Dataset, edited: Dataset) -> None:
    """Finds and commits the edit masks of all test views, unless they are there; both truths are built and peeled."""
    root = edited.root / EDIT_MASKS_FOLDER
    if is_ours(root, EDIT_MASKS) and load_sealed(root / EDIT_MASKS.head).get("dataset") == edited.seal:
        with contextlib.suppress(HyalineError):  # Missing or damaged masks are made again.
            check_files(edited.root, edit_mask_files(edited))
            return
    files: dict[str, bytes] = {}
    for split in TEST_SPLITS:
        for view in range(edited.config.split(split).views):
            shown = shows_objects(base, edited, split, view)
            mask = find_edit_mask(shown, _read_halves(base, split, view), _read_halves(edited, split, view))
            file = edit_mask_path(edited, split, view).relative_to(root).as_posix()
            files[file] = png_bytes(np.repeat(mask[..., None], 3, axis=-1))
    promised: dict[str, Json] = {f"{root.name}/{file}": sha256(data) for file, data in files.items()}
    content: dict[str, Json] = {"dataset": edited.seal, "files": promised}
    with holding(root, EDIT_MASKS, within=edited.root):
        if is_ours(root, EDIT_MASKS):
            commit_sealed(root / EDIT_MASKS.head, content)
        else:
            begin(root, EDIT_MASKS, seal_bytes(content))
        for file, data in files.items():
            commit_same(root / file, data)


def shows_objects(base: Dataset, edited: Dataset, split: Split, view: int) -> Bool[np.ndarray, "h w"]:
    """Pixels whose centre ray meets a changed object in either scene, before or as its first opaque surface."""
    assert edited.edit is not None
    shape = edited.config.resolution.shape
    shown = np.zeros(shape, bool)
    for dataset in (base, edited):
        is_changed = np.array([False, *(item.name in edited.edit.changed for item in dataset.objects)])
        is_glass = np.array([True, *(item.is_glass for item in dataset.objects)])
        in_view = np.ones(shape, bool)
        for object_id in dataset.view(split, view).layers().object_id:
            shown |= in_view & is_changed[object_id]
            in_view &= is_glass[object_id]
    return shown


def find_edit_mask(
    shown: Bool[np.ndarray, "h w"], before: Float[np.ndarray, "half h w 3"], after: Float[np.ndarray, "half h w 3"]
) -> UInt8[np.ndarray, "h w"]:
    """Where an edit shows.

    Args:
        shown: pixels that show a changed object.
        before: the two independent halves of the truth before the edit, in sRGB.
        after: the same after it. Where both truths were rendered with the same random numbers, their noise is the same
            but for light that the edit touches; so the noise is taken from the difference, not from each truth.
    """
    from scipy.ndimage import uniform_filter

    def mean_around(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return uniform_filter(np.where(shown, 0, values), WINDOW, mode="constant")

    # Of the pixels around that show no changed object, which would outshine what its light does beside it.
    share = np.maximum(mean_around(np.ones(shown.shape)), WINDOW**-2)
    first, second = after - before
    means = [mean_around(channel) / share for channel in np.moveaxis((first + second) / 2, -1, 0)]
    # The variance of the mean of two halves is the mean square of half their difference.
    variance = mean_around((((first - second) / 2) ** 2).mean(axis=-1)) / share
    # A running sum of squares may end a little below zero.
    deviation = np.sqrt(np.maximum(variance, 0) / (share * WINDOW**2))
    difference = np.sqrt(np.mean(np.square(means), axis=0))
    is_light = difference > np.maximum(SIGMAS * deviation, LEAST)
    return np.where(shown, OBJECT, np.where(is_light, LIGHT, ELSEWHERE)).astype(np.uint8)


def _read_halves(dataset: Dataset, split: Split, view: int) -> Float[np.ndarray, "half h w 3"]:
    """The two independent halves of a view's truth, in sRGB."""
    radiance, half_difference = dataset.view(split, view).radiance_and_noise()
    return srgb_from_linear(np.stack([radiance + half_difference, radiance - half_difference]))
