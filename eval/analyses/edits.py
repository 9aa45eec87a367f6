"""The scores of edited scenes in regions: what a trained renderer draws from other layers, against the edited truth."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, UInt8

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.variants import ELSEWHERE, LIGHT, OBJECT, edit_mask_files, read_edit_mask
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, to_json
from eval.analyses.variants import VariantScores
from eval.score.kept import Kept, number_from_json, number_json, picture_digests
from eval.score.metrics import masked_psnr, mean_of
from eval.score.runs import Run, has_split, read_prediction
from eval.score.scores import RunScores, SceneScores

REGIONS: dict[str, tuple[int, ...]] = {
    "object": (OBJECT,),
    "light": (LIGHT,),
    "elsewhere": (ELSEWHERE,),
    "all": (OBJECT, LIGHT, ELSEWHERE),
}
"""By name, the values of an edit mask's pixels."""

IGNORED = "truth before the edit"

Image = UInt8[np.ndarray, "h w 3"]
Masks = dict[str, Bool[np.ndarray, "h w"]]
"""By the region's name."""

RegionScores = dict[tuple[str, Split], float | None]
"""PSNR in dB by region and split, the mean over pictures that show the region; None where none does."""


@dataclass(frozen=True, kw_only=True)
class EditRow:
    """One run's scores in the regions of an edit."""

    run: str
    scene: Literal["edited", "unedited"]
    """Which scene was drawn, and is compared with its truth; the regions are the same."""
    psnr_db: RegionScores


@dataclass(frozen=True, kw_only=True, eq=False)
class EditScores:
    """One edit in regions: all runs that drew it."""

    scored: VariantScores
    shares: dict[tuple[str, Split], float]
    """Of each region in a split's pixels."""
    rows: tuple[EditRow, ...]
    """Two for each run, then the score that the truth before the edit would get: what ignoring the edit is worth."""

    @property
    def edited(self) -> Dataset:
        """The variant."""
        return self.scored.variant

    @property
    def runs(self) -> tuple[Run, ...]:
        """Each stands for its predictions of the edited scene: its folder and dataset are the edit's."""
        return tuple(scores.run for scores in self.scored.runs.values())


def score_edits(
    scene: SceneScores, variants: Sequence[VariantScores], errors: list[HyalineError], kept: Kept
) -> tuple[EditScores, ...]:
    """Every edit among these variants in regions; what cannot be scored is added to `errors`."""
    found = []
    for scored in variants:
        if scored.variant.edit is not None:
            try:
                found.append(_score_edit(scene, scored, kept))
            except HyalineError as error:
                errors.append(error)
    return tuple(found)


def object_psnr(drawn: tuple[EditScores, ...]) -> dict[str, dict[Split, float | None]]:
    """PSNR in dB where the edited objects are or were, mean over a scene's edits, by the run's name and the split.

    None where a split shows no edited object.
    """
    scores: dict[str, dict[Split, list[float]]] = {}
    for edit in drawn:
        for row in edit.rows:
            if row.scene == "edited":
                for split in TEST_SPLITS:
                    if (value := row.psnr_db[("object", split)]) is not None:
                        scores.setdefault(row.run, {}).setdefault(split, []).append(value)
    return {
        run: {split: float(np.mean(own[split])) if split in own else None for split in TEST_SPLITS}
        for run, own in scores.items()
    }


def _score_edit(scene: SceneScores, scored: VariantScores, kept: Kept) -> EditScores:
    drew = [scores for scores in scene.runs if scores.run.name in scored.runs]
    before = {split: picture_digests(scene.dataset, split) for split in TEST_SPLITS}
    about: Json = to_json(
        {
            "masks": edit_mask_files(scored.variant),
            "before": before,
            "after": {split: truth.digest for split, truth in scored.truths.items()},
            "runs": [[s.run.name, s.digests, scored.runs[s.run.name].digests] for s in drew],
        }
    )
    data = kept.get("edit", about, lambda: _edit_json(*_compare_edit(scene, scored, drew)))
    shares, rows = _edit_from_json(data)
    return EditScores(scored=scored, shares=shares, rows=rows)


EditShares = dict[tuple[str, Split], float]


def _compare_edit(
    scene: SceneScores, scored: VariantScores, drew: Sequence[RunScores]
) -> tuple[EditShares, tuple[EditRow, ...]]:
    """The shares of the regions, and the scores of the runs that drew the edit and of the truth before it."""
    edited = scored.variant
    masks: dict[Split, list[Masks]] = {split: _masks(edited, split) for split in TEST_SPLITS}
    before: dict[Split, list[Image]] = {
        split: [view.image for view in scene.dataset.views(split)] for split in TEST_SPLITS
    }
    after: dict[Split, list[Image]] = {split: list(scored.truths[split].images) for split in TEST_SPLITS}
    rows = []
    for run in (scores.run for scores in drew):
        drawn = _score_regions(scored.runs[run.name].run, after, masks)
        rows.append(EditRow(run=run.name, scene="edited", psnr_db=drawn))
        rows.append(EditRow(run=run.name, scene="unedited", psnr_db=_score_regions(run, before, masks)))
    ignored: RegionScores = {}
    for split in TEST_SPLITS:
        values = _psnr_by_region(zip(before[split], after[split], strict=True), masks[split])
        ignored |= {(region, split): value for region, value in values.items()}
    rows.append(EditRow(run=IGNORED, scene="edited", psnr_db=ignored))
    shares: EditShares = {
        (region, split): _mean_share(masks[split], region) for region in REGIONS for split in TEST_SPLITS
    }
    return shares, tuple(rows)


def _edit_json(shares: EditShares, rows: Sequence[EditRow]) -> Json:
    """All of it for `_edit_from_json`; regions in the order of REGIONS, splits in that of TEST_SPLITS."""

    def values(of: Mapping[tuple[str, Split], float | None]) -> list[Json]:
        """A list of one value for each region and split, empty where a run did not predict the split."""
        return [[number_json(of[region, split])] if (region, split) in of else [] for region, split in _places()]

    return [values(shares), [[row.run, row.scene, values(row.psnr_db)] for row in rows]]


def _edit_from_json(data: Json) -> tuple[EditShares, tuple[EditRow, ...]]:
    """The inverse of `_edit_json`."""

    def values(of: Json) -> RegionScores:
        assert isinstance(of, list)
        scores: RegionScores = {}
        for place, value in zip(_places(), of, strict=True):
            assert isinstance(value, list)
            if value:
                scores[place] = number_from_json(value[0])
        return scores

    assert isinstance(data, list) and isinstance(data[1], list)
    rows = []
    for row in data[1]:
        assert isinstance(row, list) and isinstance(row[0], str)
        rows.append(EditRow(run=row[0], scene="edited" if row[1] == "edited" else "unedited", psnr_db=values(row[2])))
    return {place: value or 0.0 for place, value in values(data[0]).items()}, tuple(rows)


def _places() -> list[tuple[str, Split]]:
    return [(region, split) for region in REGIONS for split in TEST_SPLITS]


def _score_regions(run: Run, targets: dict[Split, list[Image]], masks: dict[Split, list[Masks]]) -> RegionScores:
    """PSNR of a run's predictions in regions, on the splits that it predicted."""
    scores: RegionScores = {}
    for split in TEST_SPLITS:
        if has_split(run, split):
            views = range(run.dataset.config.split(split).views)
            drawn = (read_prediction(run, split, view) for view in views)
            found = _psnr_by_region(zip(drawn, targets[split], strict=True), masks[split])
            scores |= {(region, split): value for region, value in found.items()}
    return scores


def _masks(edited: Dataset, split: Split) -> list[Masks]:
    masks = [read_edit_mask(edited, split, view) for view in range(edited.config.split(split).views)]
    return [{name: np.isin(mask, values) for name, values in REGIONS.items()} for mask in masks]


def _psnr_by_region(pictures: Iterable[tuple[Image, Image]], masks: Iterable[Masks]) -> dict[str, float | None]:
    """PSNR in dB of each region: the mean over (prediction, truth) pairs of one value per picture that shows it."""
    values: dict[str, list[float | None]] = {}
    for (pred, target), regions in zip(pictures, masks, strict=True):
        for name, mask in regions.items():
            values.setdefault(name, []).append(masked_psnr(pred, target, mask) if mask.any() else None)
    return {name: mean_of(found) for name, found in values.items()}


def _mean_share(masks: list[Masks], name: str) -> float:
    """The share of a region in all pixels of a split."""
    return float(np.mean([regions[name] for regions in masks]))
