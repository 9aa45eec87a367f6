"""The scores of variants: predictions of other cameras, another size or an edited scene, against its own truth.

Two kinds have a table here: splits by angle (cameras 10, 20 and 40 degrees outside of the training cameras), and
super-resolution (predictions at twice the size and more).
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from datagen.data.config import ANGLE_SPLITS, TEST_SPLITS, Resolution, Split
from datagen.data.dataset import Dataset
from datagen.data.variants import list_variants, open_variant, parent_views, variant_root
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.terminal.command import track
from eval.score.runs import Run, has_split, read_prediction, within
from eval.score.scores import (
    RunScores,
    SceneScores,
    SplitScores,
    Truth,
    read_truth,
    score_picture,
    score_run,
)
from eval.tables.grids import CEILING, MISSING, Column, Grid, format_number
from eval.tables.results import splits_json

ANGLE_KEYS = {"psnr_db": "PSNR dB ↑", "glass_psnr_db": "PSNR glass dB ↑"}

ANGLE_NOTES = (
    "10°, 20°, 40°: cameras so far outside of the directions that training cameras cover, at the training distance and "
    "aimed at the centre (datagen/builder/angles.py); inter are those inside.",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class VariantScores:
    """All runs that predicted one variant."""

    variant: Dataset
    truths: dict[Split, Truth]
    runs: dict[str, RunScores]
    """By the run's name; the folder and the dataset of each `run` are the variant's."""


def score_variants(
    scene: SceneScores, errors: list[HyalineError], *, of: Callable[[Dataset], bool] = lambda _: True
) -> list[VariantScores]:
    """The scores of each variant that a run has predicted; problems of pictures or truth are added to `errors`.

    Args:
        of: true for variants to score.
    """
    scored = []
    for name in list_variants(scene.dataset.root):
        if not any((variant_root(scores.run.folder, name) / "predictions").is_dir() for scores in scene.runs):
            continue
        try:
            variant = open_variant(scene.dataset, name)
            if not of(variant):
                continue
            if (found := _score(scene, variant, errors)).runs:
                scored.append(found)
        except HyalineError as error:
            errors.append(error)
    return scored


def run_of_variant(run: Run, variant: Dataset) -> Run | None:
    """A run's predictions of a variant as a run of its own; None if there are none.

    They are at RUN/variants/NAME/predictions/SPLIT/0000.png, also for foreign methods.
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


def _score(scene: SceneScores, variant: Dataset, errors: list[HyalineError]) -> VariantScores:
    truths: dict[Split, Truth] = {split: read_truth(variant, split) for split in variant.splits}
    runs = {}
    for scores in track(scene.runs, label=f"scoring {variant.root}", total=len(scene.runs)):
        try:
            if (found := run_of_variant(scores.run, variant)) is not None:
                runs[found.name] = score_run(found, truths)
        except HyalineError as error:
            errors.append(error)
    return VariantScores(variant=variant, truths=truths, runs=runs)


def angle_grid(scene: SceneScores, scored: VariantScores) -> Grid:
    """The table of these scores, next to those of the interpolating split."""
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


KEYS = {"psnr_db": ("PSNR dB ↑", 2), "glass_psnr_db": ("PSNR glass dB ↑", 2), "ssim": ("SSIM ↑", 3)}
TRUTH_ENLARGED = "truth"
DRAWN, ENLARGED = "at that size", "enlarged"

SUPER_RESOLUTION_NOTES = (
    "At that size: the run, trained at the dataset's size, drew larger pictures. Enlarged: its pictures of the "
    "dataset's size, by cubic splines on sRGB (scikit-image). Truth, enlarged: the same of the true pictures.",
)


Enlarged = dict[str, dict[Split, SplitScores | None]]
"""Scores of enlarged pictures by the run's name; `TRUTH_ENLARGED` for the true ones."""


def score_enlarged(scene: SceneScores, scored: VariantScores) -> Enlarged:
    """The scores of the enlarged small pictures of each run that predicted a larger variant."""
    runs = [scores for scores in scene.runs if scores.run.name in scored.runs]
    return {
        TRUTH_ENLARGED: _enlarged(scene.dataset, scored, None),
        **{scores.run.name: _enlarged(scene.dataset, scored, scores) for scores in runs},
    }


def enlarge(image: UInt8[np.ndarray, "h w 3"], size: Resolution) -> UInt8[np.ndarray, "tall wide 3"]:
    """A picture at another size by cubic splines through its pixels' centres, clipped; edges are repeated beyond."""
    from skimage.transform import resize

    values = np.asarray(resize(image / 255, size.shape, order=3, mode="edge", anti_aliasing=False))
    return np.rint(values.clip(0, 1) * 255).astype(np.uint8)


def super_resolution_grid(scene: SceneScores, scaled: list[tuple[VariantScores, Enlarged]]) -> Grid:
    """The table of all sizes."""
    rows: list[tuple[str, ...]] = []
    for scored, enlarged in scaled:
        size = str(scored.variant.config.resolution)
        listed = [(name, DRAWN, scores.splits) for name, scores in scored.runs.items()]
        listed += [(name, ENLARGED, splits) for name, splits in enlarged.items()]
        order = {name: place for place, name in enumerate([*scored.runs, TRUTH_ENLARGED])}
        for name, how, splits in sorted(listed, key=lambda row: order[row[0]]):
            rows.append(
                (
                    size,
                    name,
                    how,
                    *(
                        format_number(None if (values := splits[split]) is None else values.mean(key), decimals)
                        for key, (_, decimals) in KEYS.items()
                        for split in TEST_SPLITS
                    ),
                )
            )
        ceilings = [format_number(scored.truths[split].ceiling_db, 2) for split in TEST_SPLITS]
        rows.append((size, CEILING, "", *ceilings, *[MISSING] * (len(TEST_SPLITS) * (len(KEYS) - 1))))
    texts = ("size", "run", "pictures")
    return Grid(
        title=f"{scene.title}: super-resolution, trained at {scene.dataset.config.resolution}",
        columns=(
            *(Column(group=text, is_number=False) for text in texts),
            *(Column(group=title, split=split) for title, _ in KEYS.values() for split in TEST_SPLITS),
        ),
        rows=tuple(rows),
        notes=SUPER_RESOLUTION_NOTES,
    )


def super_resolution_json(scored: VariantScores, enlarged: Enlarged) -> dict[str, Json]:
    """The scores of the predicted pictures and of the enlarged ones."""
    return {
        **variant_json(scored),
        "resolution": dataclasses.asdict(scored.variant.config.resolution),
        "enlarged": {name: splits_json(splits) for name, splits in enlarged.items()},
    }


def _enlarged(dataset: Dataset, scored: VariantScores, scores: RunScores | None) -> dict[Split, SplitScores | None]:
    """The scores of enlarged predictions; without a run, of the enlarged truth."""
    return {
        split: _score_enlarged(dataset, truth, scores) if scores is None or scores.splits[split] is not None else None
        for split, truth in scored.truths.items()
    }


def _score_enlarged(dataset: Dataset, truth: Truth, scores: RunScores | None) -> SplitScores:
    split, size = truth.split, truth.dataset.config.resolution
    rows = []
    for place, view in enumerate(parent_views(truth.dataset, split)):
        small = dataset.view(split, view).image if scores is None else read_prediction(scores.run, split, view)
        glass = None if truth.glass is None else truth.glass[place]
        rows.append(score_picture(enlarge(small, size), truth.images[place], glass))
    return SplitScores(images={key: tuple(row[key] for row in rows) for key in rows[0]})
