"""Scores of parts of pictures: PSNR inside masks that say what a pixel shows."""

from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Bool, UInt8

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from eval.score.metrics import masked_psnr, mean_of
from eval.score.runs import Run, read_prediction

Image = UInt8[np.ndarray, "h w 3"]
Masks = dict[str, Bool[np.ndarray, "h w"]]
"""By the region's name."""

RegionScores = dict[tuple[str, Split], float | None]
"""PSNR in dB by region and split, the mean over pictures that show the region; None where none does."""


def psnr_by_region(pictures: Iterable[tuple[Image, Image]], masks: Iterable[Masks]) -> dict[str, float | None]:
    """PSNR in dB of each region: the mean over (prediction, truth) pairs of one value per picture that shows it."""
    values: dict[str, list[float | None]] = {}
    for (pred, target), regions in zip(pictures, masks, strict=True):
        for name, mask in regions.items():
            values.setdefault(name, []).append(masked_psnr(pred, target, mask) if mask.any() else None)
    return {name: mean_of(found) for name, found in values.items()}


def mean_share(masks: list[Masks], name: str) -> float:
    """The share of a region in all pixels of a split."""
    return float(np.mean([regions[name] for regions in masks]))


def truths(dataset: Dataset, split: Split) -> list[Image]:
    """All pictures of a split, verified."""
    return [dataset.view(split, view).image for view in range(dataset.config.split(split).views)]


def predictions(run: Run, split: Split) -> Iterator[Image]:
    """All of a run's pictures of a split."""
    return (read_prediction(run, split, view) for view in range(run.dataset.config.split(split).views))
