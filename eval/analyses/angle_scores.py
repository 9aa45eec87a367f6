"""Owns the scores on the splits by angle: cameras 10, 20 and 40 degrees outside of what training covers."""

import dataclasses

from datagen.data.config import ANGLE_SPLITS, Split
from datagen.data.variants import ANGLES, open_annex
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from eval.score.metrics import mean_of
from eval.score.runs import has_split
from eval.score.scores import RunScores, SceneScores, SplitScores, Truth, read_truth, score_run
from eval.tables.grids import CEILING, MISSING, Column, Grid, format_number

KEYS = {"psnr_db": "PSNR dB ↑", "glass_psnr_db": "PSNR glass dB ↑"}

ANGLE_NOTES = (
    "10°, 20°, 40°: cameras so far outside of the directions that training cameras cover, at the training distance and "
    "aimed at the centre (datagen/build/angles.py); inter are those inside.",
)


def read_angle_truths(scene: SceneScores, errors: list[HyalineError]) -> dict[Split, Truth]:
    """The truth of the splits by angle; empty where they were not built, or (added to `errors`) not to their end."""
    try:
        annex = open_annex(scene.dataset, ANGLES)
        return {} if annex is None else {split: read_truth(annex, split) for split in annex.splits}
    except HyalineError as error:
        errors.append(error)
        return {}


def score_angles(scene: SceneScores, truths: dict[Split, Truth], errors: list[HyalineError]) -> dict[str, RunScores]:
    """The scores of runs that predicted any of these splits, by name; what pictures lack is added to `errors`."""
    annex = open_annex(scene.dataset, ANGLES) if truths else None
    if annex is None:
        return {}
    scored = {}
    for scores in scene.runs:
        run = dataclasses.replace(scores.run, dataset=annex)
        try:
            if any(has_split(run, split) for split in truths):
                scored[run.name] = score_run(run, truths)
        except HyalineError as error:
            errors.append(error)
    return scored


def angle_grid(scene: SceneScores, truths: dict[Split, Truth], scored: dict[str, RunScores]) -> Grid:
    """The table of these scores, beside those of the interpolating split."""
    splits: list[Split] = ["interpolating", *ANGLE_SPLITS]
    inside = {scores.run.name: scores for scores in scene.runs}
    rows = []
    for name, scores in scored.items():
        values = [
            (inside[name] if split == "interpolating" else scores).mean(key, split) for key in KEYS for split in splits
        ]
        rows.append((name, *(format_number(value, 2) for value in values)))
    ceilings = [scene.ceilings_db["interpolating"], *(truths[split].ceiling_db for split in ANGLE_SPLITS)]
    rows.append((CEILING, *(format_number(value, 2) for value in ceilings), *[MISSING] * len(splits)))
    return Grid(
        title=f"{scene.title}: extrapolating by angle",
        columns=(
            Column(group="run", is_number=False),
            *(Column(group=title, split=split) for title in KEYS.values() for split in splits),
        ),
        rows=tuple(rows),
        last_row_apart=True,
        notes=ANGLE_NOTES,
    )


def angles_json(truths: dict[Split, Truth], scored: dict[str, RunScores]) -> Json:
    """Noise ceilings, and of every run, split and metric the mean and each picture's value."""
    return {
        "noise_ceiling_db": {split: truth.ceiling_db for split, truth in truths.items()},
        "runs": {name: splits_json(scores.splits) for name, scores in scored.items()},
    }


def splits_json(splits: dict[Split, SplitScores | None]) -> Json:
    """By split and metric: the mean, and each picture's value."""
    return {
        split: None
        if values is None
        else {key: {"mean": mean_of(images), "pictures": list(images)} for key, images in values.images.items()}
        for split, values in splits.items()
    }
