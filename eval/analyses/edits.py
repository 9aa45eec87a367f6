"""Owns the scores of edited scenes: what a trained renderer draws from other layers, against the edited truth."""

import shlex
from dataclasses import dataclass
from typing import Literal

import numpy as np

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.edit_masks import ELSEWHERE, LIGHT, OBJECT, read_footprint
from datagen.data.edited import list_edits, open_edit
from datagen.disk.errors import HyalineError
from datagen.disk.storage import load_sealed
from eval.score.regions import Image, Masks, RegionScores, mean_share, predictions, psnr_by_region, truths
from eval.score.runs import Run, has_split, within
from eval.score.scores import SceneScores

REGIONS: dict[str, tuple[int, ...]] = {
    "object": (OBJECT,),
    "light": (LIGHT,),
    "elsewhere": (ELSEWHERE,),
    "all": (OBJECT, LIGHT, ELSEWHERE),
}
"""By name, the values of a footprint's pixels."""

IGNORED = "truth before the edit"


@dataclass(frozen=True, kw_only=True)
class EditRow:
    """One run's scores in the regions of an edit."""

    run: str
    scene: Literal["edited", "unedited"]
    """Which scene was drawn, and is compared with its truth; the regions are the same."""
    psnr_db: RegionScores


@dataclass(frozen=True, kw_only=True, eq=False)
class EditScores:
    """All runs that drew one edit."""

    edited: Dataset
    shares: dict[tuple[str, Split], float]
    """Of each region in a split's pixels."""
    runs: tuple[Run, ...]
    """Each stands for its predictions of the edited scene: its folder and dataset are the edit's."""
    rows: tuple[EditRow, ...]
    """Two for each run, then the score that the truth before the edit would get: what ignoring the edit is worth."""


def score_edits(scene: SceneScores, errors: list[HyalineError]) -> tuple[EditScores, ...]:
    """Every edit of the scene that a run has drawn; what cannot be scored is added to `errors`."""
    scored = []
    for name in list_edits(scene.dataset):
        try:
            edited = open_edit(scene.dataset, name)
            pairs = [(scores.run, found) for scores in scene.runs if (found := edit_run(scores.run, edited))]
            if pairs:
                scored.append(_score_edit(scene.dataset, edited, pairs))
        except HyalineError as error:
            errors.append(error)
    return tuple(scored)


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


def edit_run(run: Run, edited: Dataset) -> Run | None:
    """A run's predictions of an edited scene as a run of its own; None where it has none.

    They lie at RUN/edits/NAME/predictions/SPLIT/0000.png, whoever made them.

    Raises:
        HyalineError: a picture is missing or too many, or they were made for another version of the edit.
    """
    folder = run.folder / "edits" / edited.name
    found = within(run, folder, edited)
    if not any(has_split(found, split) for split in TEST_SPLITS):
        return None
    record = folder / "predictions.json"
    if record.is_file() and load_sealed(record).get("dataset_seal") != edited.seal:
        raise HyalineError(
            f"{folder}: made for another version of {edited.root}; "
            f"render again with `model render --run {shlex.quote(str(run.folder))} --edit {edited.name}`"
        )
    return found


def _score_edit(base: Dataset, edited: Dataset, pairs: list[tuple[Run, Run]]) -> EditScores:
    masks: dict[Split, list[Masks]] = {split: _masks(edited, split) for split in TEST_SPLITS}
    before: dict[Split, list[Image]] = {split: truths(base, split) for split in TEST_SPLITS}
    after: dict[Split, list[Image]] = {split: truths(edited, split) for split in TEST_SPLITS}
    rows = []
    for run, found in pairs:
        rows.append(EditRow(run=run.name, scene="edited", psnr_db=score_regions(found, after, masks)))
        rows.append(EditRow(run=run.name, scene="unedited", psnr_db=score_regions(run, before, masks)))
    ignored: RegionScores = {}
    for split in TEST_SPLITS:
        scores = psnr_by_region(zip(before[split], after[split], strict=True), masks[split])
        ignored |= {(region, split): value for region, value in scores.items()}
    rows.append(EditRow(run=IGNORED, scene="edited", psnr_db=ignored))
    shares: dict[tuple[str, Split], float] = {
        (region, split): mean_share(masks[split], region) for region in REGIONS for split in TEST_SPLITS
    }
    return EditScores(edited=edited, shares=shares, runs=tuple(found for _, found in pairs), rows=tuple(rows))


def score_regions(run: Run, targets: dict[Split, list[Image]], masks: dict[Split, list[Masks]]) -> RegionScores:
    """PSNR of a run's predictions in regions, on the splits that it predicted."""
    scores: RegionScores = {}
    for split in TEST_SPLITS:
        if has_split(run, split):
            found = psnr_by_region(zip(predictions(run, split), targets[split], strict=True), masks[split])
            scores |= {(region, split): value for region, value in found.items()}
    return scores


def _masks(edited: Dataset, split: Split) -> list[Masks]:
    footprints = [read_footprint(edited, split, view) for view in range(edited.config.split(split).views)]
    return [{name: np.isin(footprint, values) for name, values in REGIONS.items()} for footprint in footprints]
