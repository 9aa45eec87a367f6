"""The test of order: how well runs draw pixels whose surfaces appear in an order that no training pixel had.

A renderer that stacks its layers may have learned orders by heart. The order of a pixel is the sequence of object ids
along its centre ray, of the first few layers of the true geometry; a copy counts as its original.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8, UInt64

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.terminal.command import track
from eval.analyses.edits import EditScores, score_regions
from eval.score.regions import Image, Masks, RegionScores, mean_share, truths
from eval.score.runs import Run
from eval.score.scores import SceneScores

MAX_LAYERS = 8
"""Ids of so many layers fit into 64 bits."""

UNEDITED = "as trained"


@dataclass(frozen=True, kw_only=True)
class OrderRow:
    """One run on one scene, by whether training had a pixel's order."""

    scene: str
    """`UNEDITED`, or the edit's name."""
    run: str
    psnr_db: RegionScores
    """Regions `seen` and `new`."""
    new_share: dict[Split, float]
    """Share of the pixels whose order is new."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OrderScores:
    """All runs of a scene and of its edits."""

    num_layers: int
    rows: tuple[OrderRow, ...]


def check_order_layers(num_layers: int) -> None:
    """Raises a HyalineError where no order can be told from so many layers."""
    if not 1 <= num_layers <= MAX_LAYERS:
        raise HyalineError(f"--order: is {num_layers}; expected 1 to {MAX_LAYERS} layers, 4 is a good choice")


def score_order(scene: SceneScores, edits: tuple[EditScores, ...], num_layers: int) -> OrderScores:
    """Every run of a scene and of its edits, on pixels of known and of new order.

    Raises:
        HyalineError: the true geometry has no straight layers.
    """
    base = scene.dataset
    known = _known_orders(base, num_layers, title=scene.title)
    rows = _rows(UNEDITED, base, [scores.run for scores in scene.runs], known, num_layers)
    for edit in edits:
        rows += _rows(edit.edited.name, edit.edited, edit.runs, known, num_layers)
    return OrderScores(num_layers=num_layers, rows=tuple(rows))


def orders(object_id: UInt8[np.ndarray, "layer h w"], num_layers: int) -> UInt64[np.ndarray, "h w"]:
    """A number for each pixel's order: equal where the first `num_layers` layers show the same objects in turn."""
    codes = np.zeros(object_id.shape[1:], np.uint64)
    for layer in object_id[:num_layers]:
        codes = (codes << np.uint64(8)) | layer
    return codes


def _known_orders(dataset: Dataset, num_layers: int, *, title: str) -> UInt64[np.ndarray, " order"]:
    """The orders of all training pixels."""
    known = np.zeros(0, np.uint64)
    views = range(dataset.config.train.views)
    for view in track(views, label=f"orders in the training of {title}", total=len(views)):
        ids = dataset.view("train", view).object_ids()
        known = np.union1d(known, orders(ids, num_layers))
    return known


def _rows(
    name: str, dataset: Dataset, runs: Sequence[Run], known: UInt64[np.ndarray, " order"], num_layers: int
) -> list[OrderRow]:
    masks: dict[Split, list[Masks]] = {split: _masks(dataset, split, known, num_layers) for split in TEST_SPLITS}
    targets: dict[Split, list[Image]] = {split: truths(dataset, split) for split in TEST_SPLITS}
    shares: dict[Split, float] = {split: mean_share(masks[split], "new") for split in TEST_SPLITS}
    return [
        OrderRow(scene=name, run=run.name, psnr_db=score_regions(run, targets, masks), new_share=shares) for run in runs
    ]


def _masks(dataset: Dataset, split: Split, known: UInt64[np.ndarray, " order"], num_layers: int) -> list[Masks]:
    id_of = np.arange(len(dataset.objects) + 1, dtype=np.uint8)
    if dataset.edit is not None:
        names = ["", *(item.name for item in dataset.objects)]
        for copy, original in dataset.edit.copies.items():
            id_of[names.index(copy)] = names.index(original)
    masks: list[Masks] = []
    for view in range(dataset.config.split(split).views):
        ids = id_of[dataset.view(split, view).object_ids()]
        seen: Bool[np.ndarray, "h w"] = np.isin(orders(ids, num_layers), known)
        masks.append({"seen": seen, "new": ~seen})
    return masks
