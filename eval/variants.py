"""Variants: scores of predictions for other cameras, another size or an edited scene, against their own truth.

Predictions are at RUN/variants/NAME/predictions/SPLIT/0000.png, also for foreign methods; of edits also by region.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.variants import ELSEWHERE, LIGHT, OBJECT, list_variants, open_variant, read_edit_mask, variant_root
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, to_json
from datagen.terminal.command import track
from eval.score.metrics import masked_psnr, mean_of
from eval.score.runs import Run, has_split, read_prediction, within
from eval.score.scores import RunScores, SceneScores, Truth, group_seeds, read_truth, score_run
from eval.tables.grids import Column, Grid, format_number
from eval.tables.results import splits_json

REGIONS: dict[str, tuple[int, ...]] = {
    "object": (OBJECT,),
    "light": (LIGHT,),
    "elsewhere": (ELSEWHERE,),
    "all": (OBJECT, LIGHT, ELSEWHERE),
}
"""Values of an edit mask's pixels, by region."""
IGNORED = "truth before the edit"

EDIT_NOTES = (
    "Object: pixels that show a changed object in either scene. Light: other pixels where the truth changes by more "
    "than its noise. Truth before the edit: what a perfect renderer that ignores the edit would score. Of runs that "
    "differ in their seed alone: means over the seeds.",
)

RegionScores = dict[str, dict[Split, float | None]]
"""PSNR in dB by region and split, the mean over pictures that show the region; None where none does."""
ReadImage = Callable[[Split, int], UInt8[np.ndarray, "h w 3"]]


@dataclass(frozen=True, kw_only=True, eq=False)
class VariantScores:
    """All runs that predicted one variant."""

    variant: Dataset
    truths: dict[Split, Truth]
    runs: dict[str, RunScores]
    """By the run's name; the folder and the dataset of each `run` are the variant's."""
    regions: dict[str, RegionScores]
    """Of an edit, by the run's name; `IGNORED` for the truth before the edit."""


def score_variants(
    scene: SceneScores, errors: list[HyalineError], *, of: Callable[[Dataset], bool] = lambda _: True
) -> list[VariantScores]:
    """The scores of each variant that a run has predicted; problems of pictures or truth are added to `errors`.

    Args:
        of: true for variants to score.
    """
    scored = []
    known = list_variants(scene.dataset.root)
    for path in (path for scores in scene.runs for path in scores.run.folder.glob("variants/*/predictions")):
        if path.parent.name not in known:
            there = ", ".join(known) or "none"
            errors.append(HyalineError(f"{path.parent}: the dataset has no such variant; it has {there}"))
    for name in known:
        if any((variant_root(scores.run.folder, name) / "predictions").is_dir() for scores in scene.runs):
            try:
                variant = open_variant(scene.dataset, name)
                if of(variant) and (found := _score(scene, variant, errors)).runs:
                    scored.append(found)
            except HyalineError as error:
                errors.append(error)
    return scored


def run_of_variant(run: Run, variant: Dataset) -> Run | None:
    """A run's predictions of a variant as a run of its own; None if there are none."""
    found = within(run, variant_root(run.folder, variant.name), variant)
    return found if any(has_split(found, split) for split in variant.splits) else None


def variant_json(scored: VariantScores) -> dict[str, Json]:
    """Noise ceilings, and of every run, split and metric the mean and each picture's value; an edit's regions."""
    edit = scored.variant.edit
    return {
        "dataset_seal": scored.variant.seal,
        "noise_ceiling_db": {split: truth.ceiling_db for split, truth in scored.truths.items()},
        "runs": {name: splits_json(scores.splits) for name, scores in scored.runs.items()},
        **({} if edit is None else {"edits": list(edit.edits), "regions_psnr_db": to_json(scored.regions)}),
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
    regions: dict[str, RegionScores] = {}
    if variant.edit is not None:
        for name, scores in runs.items():
            regions[name] = _score_regions(
                truths, lambda split, view, run=scores.run: read_prediction(run, split, view), scores.splits
            )
        before: dict[Split, Sequence[UInt8[np.ndarray, "h w 3"]]] = {
            split: scene.truths[split].images for split in TEST_SPLITS
        }
        regions[IGNORED] = _score_regions(truths, lambda split, view: before[split][view], before)
    return VariantScores(variant=variant, truths=truths, runs=runs, regions=regions)


def _score_regions(truths: dict[Split, Truth], read: ReadImage, splits: Mapping[Split, object]) -> RegionScores:
    """PSNR of pictures in an edit's regions; None for splits that are missing."""
    found: RegionScores = {region: {} for region in REGIONS}
    for split, truth in truths.items():
        values: dict[str, list[float | None]] = {region: [] for region in REGIONS}
        for view, target in enumerate(truth.images if splits.get(split) is not None else ()):
            picture, mask = read(split, view), read_edit_mask(truth.dataset, split, view)
            for region, kinds in REGIONS.items():
                inside = np.isin(mask, kinds)
                values[region].append(masked_psnr(picture, target, inside) if inside.any() else None)
        for region, of_pictures in values.items():
            found[region][split] = mean_of(of_pictures)
    return found


def object_psnr(edits: Sequence[VariantScores]) -> dict[str, dict[str, dict[Split, float | None]]]:
    """PSNR in dB where the edited objects are or were, by the run's name, the edit and the split.

    None if a split does not show any edited object.
    """
    names = {name for edit in edits for name in edit.regions}
    return {
        name: {edit.variant.name: edit.regions[name]["object"] for edit in edits if name in edit.regions}
        for name in sorted(names)
    }


def edit_grid(scene: SceneScores, edit: VariantScores) -> Grid:
    """PSNR by region of an edit; means over seeds."""
    record = edit.variant.edit
    assert record is not None
    rows = []
    for group in group_seeds(scene.runs):
        if names := [scores.run.name for scores in group.runs if scores.run.name in edit.runs]:
            rows.append((group.name if len(names) > 1 else names[0], str(len(names)), *_cells(edit, names)))
    rows.append((IGNORED, "", *_cells(edit, [IGNORED])))
    return Grid(
        title=f"{scene.title}, after {' then '.join(record.edits)}",
        columns=(
            Column(group="run", is_number=False),
            Column(group="seeds"),
            *(Column(group=f"{region} dB ↑", split=split) for region in REGIONS for split in TEST_SPLITS),
        ),
        rows=tuple(rows),
        last_row_apart=True,
        notes=EDIT_NOTES,
    )


def _cells(edit: VariantScores, names: Sequence[str]) -> list[str]:
    return [
        format_number(mean_of([edit.regions[name][region][split] for name in names]), 2)
        for region in REGIONS
        for split in TEST_SPLITS
    ]
