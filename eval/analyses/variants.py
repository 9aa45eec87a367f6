"""The scores of variants: what runs drew of other cameras, another size or an edited scene, against its own truth.

The splits by angle, cameras 10, 20 and 40 degrees outside of what training covers, have a table here.
"""

from dataclasses import dataclass

from datagen.data.config import ANGLE_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.variants import list_variants, open_variant, variant_root
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.terminal.command import track
from eval.score.kept import Kept
from eval.score.metrics import mean_of
from eval.score.runs import Run, has_split, within
from eval.score.scores import RunScores, SceneScores, SplitScores, Truth, read_truth, score_run
from eval.tables.grids import CEILING, MISSING, Column, Grid, format_number

ANGLE_KEYS = {"psnr_db": "PSNR dB ↑", "glass_psnr_db": "PSNR glass dB ↑"}

ANGLE_NOTES = (
    "10°, 20°, 40°: cameras so far outside of the directions that training cameras cover, at the training distance and "
    "aimed at the centre (datagen/build/angles.py); inter are those inside.",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class VariantScores:
    """All runs that drew one variant."""

    variant: Dataset
    truths: dict[Split, Truth]
    runs: dict[str, RunScores]
    """By the run's name; the folder and the dataset of each `run` are the variant's."""


def score_variants(
    scene: SceneScores, errors: list[HyalineError], kept: Kept, *, edits_alone: bool = False
) -> list[VariantScores]:
    """The scores of each variant that a run has drawn; what pictures or truth lack is added to `errors`."""
    scored = []
    for name in list_variants(scene.dataset.root):
        if not any((variant_root(scores.run.folder, name) / "predictions").is_dir() for scores in scene.runs):
            continue
        try:
            variant = open_variant(scene.dataset, name)
            if edits_alone and variant.edit is None:
                continue
            if (found := _score(scene, variant, errors, kept)).runs:
                scored.append(found)
        except HyalineError as error:
            errors.append(error)
    return scored


def run_of_variant(run: Run, variant: Dataset) -> Run | None:
    """A run's predictions of a variant as a run of its own; None where it has none.

    They lie at RUN/variants/NAME/predictions/SPLIT/0000.png, whoever made them.

    Raises:
        HyalineError: a picture is missing or too many, or they are of another version of the variant or of another run.
    """
    folder = variant_root(run.folder, variant.name)
    found = within(run, folder, variant)
    return found if any(has_split(found, split) for split in variant.splits) else None


def variant_json(scored: VariantScores) -> dict[str, Json]:
    """Noise ceilings, and of every run, split and metric the mean and each picture's value."""
    return {
        "dataset_seal": scored.variant.seal,
        "noise_ceiling_db": {split: truth.ceiling_db for split, truth in scored.truths.items()},
        "runs": {name: splits_json(scores.splits) for name, scores in scored.runs.items()},
    }


def splits_json(splits: dict[Split, SplitScores | None]) -> Json:
    """By split and metric: the mean, and each picture's value."""
    return {
        split: None
        if values is None
        else {key: {"mean": mean_of(images), "pictures": list(images)} for key, images in values.images.items()}
        for split, values in splits.items()
    }


def _score(scene: SceneScores, variant: Dataset, errors: list[HyalineError], kept: Kept) -> VariantScores:
    truths: dict[Split, Truth] = {split: read_truth(variant, split) for split in variant.splits}
    runs = {}
    for scores in track(scene.runs, label=f"scoring {variant.root}", total=len(scene.runs)):
        try:
            if (found := run_of_variant(scores.run, variant)) is not None:
                runs[found.name] = score_run(found, truths, kept)
        except HyalineError as error:
            errors.append(error)
    return VariantScores(variant=variant, truths=truths, runs=runs)


def angle_grid(scene: SceneScores, scored: VariantScores) -> Grid:
    """The table of these scores, beside those of the interpolating split."""
    splits: list[Split] = ["interpolating", *ANGLE_SPLITS]
    inside = {scores.run.name: scores for scores in scene.runs}
    rows = []
    for name, scores in scored.runs.items():
        values = [
            (inside[name] if split == "interpolating" else scores).mean(key, split)
            for key in ANGLE_KEYS
            for split in splits
        ]
        rows.append((name, *(format_number(value, 2) for value in values)))
    ceilings = [scene.ceilings_db["interpolating"], *(scored.truths[split].ceiling_db for split in ANGLE_SPLITS)]
    rows.append((CEILING, *(format_number(value, 2) for value in ceilings), *[MISSING] * len(splits)))
    return Grid(
        title=f"{scene.title}: extrapolating by angle",
        columns=(
            Column(group="run", is_number=False),
            *(Column(group=title, split=split) for title in ANGLE_KEYS.values() for split in splits),
        ),
        rows=tuple(rows),
        last_row_apart=True,
        notes=ANGLE_NOTES,
    )
