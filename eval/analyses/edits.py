"""Edited scenes: scores by region of what runs predict for them, their tables, results.json entries and sheets."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, UInt8

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.paths import view_name
from datagen.data.variants import ELSEWHERE, LIGHT, OBJECT, read_edit_mask
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from eval.analyses.variants import VariantScores, variant_json
from eval.score.metrics import masked_psnr, mean_of, psnr
from eval.score.runs import Run, has_split, read_prediction
from eval.score.scores import RunScores, SceneScores
from eval.score.seeds import by_group
from eval.tables.grids import MEANS_NOTE, Column, Grid, format_number, psnr_text

REGIONS: dict[str, tuple[int, ...]] = {
    "object": (OBJECT,),
    "light": (LIGHT,),
    "elsewhere": (ELSEWHERE,),
    "all": (OBJECT, LIGHT, ELSEWHERE),
}
"""Values of an edit mask's pixels, by region."""

IGNORED = "truth before the edit"

Image = UInt8[np.ndarray, "h w 3"]
Masks = dict[str, Bool[np.ndarray, "h w"]]
"""Masks by region."""

RegionScores = dict[tuple[str, Split], float | None]
"""PSNR in dB by region and split, the mean over pictures that show the region; None where none does."""


@dataclass(frozen=True, kw_only=True)
class EditRow:
    """One run's scores in the regions of an edit."""

    run: str
    scene: Literal["edited", "unedited"]
    """The scene that was predicted and is compared with its truth; the regions are the same."""
    psnr_db: RegionScores


@dataclass(frozen=True, kw_only=True, eq=False)
class EditScores:
    """One edit in regions: all runs that drew it."""

    scored: VariantScores
    shares: dict[tuple[str, Split], float]
    """Share of each region in a split's pixels."""
    rows: tuple[EditRow, ...]
    """Two rows for each run, then the score of the truth before the edit, as if the edit were ignored."""

    @property
    def edited(self) -> Dataset:
        """The variant."""
        return self.scored.variant

    @property
    def runs(self) -> tuple[Run, ...]:
        """The runs with their predictions of the edited scene: folder and dataset are the edit's."""
        return tuple(scores.run for scores in self.scored.runs.values())


def score_edits(
    scene: SceneScores, variants: Sequence[VariantScores], errors: list[HyalineError]
) -> tuple[EditScores, ...]:
    """The scores of every edit among these variants by region; failures are added to `errors`."""
    found = []
    for scored in variants:
        if scored.variant.edit is not None:
            try:
                found.append(_score_edit(scene, scored))
            except HyalineError as error:
                errors.append(error)
    return tuple(found)


def object_psnr(drawn: tuple[EditScores, ...]) -> dict[str, dict[str, dict[Split, float | None]]]:
    """PSNR in dB where the edited objects are or were, by the run's name, the edit and the split.

    None if a split does not show any edited object.
    """
    scores: dict[str, dict[str, dict[Split, float | None]]] = {}
    for edit in drawn:
        for row in edit.rows:
            if row.scene == "edited":
                values: dict[Split, float | None] = {split: row.psnr_db[("object", split)] for split in TEST_SPLITS}
                scores.setdefault(row.run, {})[edit.edited.name] = values
    return scores


def _score_edit(scene: SceneScores, scored: VariantScores) -> EditScores:
    """The shares of the regions, and the scores of the runs that drew the edit and of the truth before it."""
    edited = scored.variant
    masks: dict[Split, list[Masks]] = {split: _masks(edited, split) for split in TEST_SPLITS}
    before: dict[Split, Sequence[Image]] = {split: scene.truths[split].images for split in TEST_SPLITS}
    after: dict[Split, Sequence[Image]] = {split: scored.truths[split].images for split in TEST_SPLITS}
    rows = []
    for run in (scores.run for scores in scene.runs if scores.run.name in scored.runs):
        drawn = _score_regions(scored.runs[run.name].run, after, masks)
        rows.append(EditRow(run=run.name, scene="edited", psnr_db=drawn))
        rows.append(EditRow(run=run.name, scene="unedited", psnr_db=_score_regions(run, before, masks)))
    ignored: RegionScores = {}
    for split in TEST_SPLITS:
        values = _psnr_by_region(zip(before[split], after[split], strict=True), masks[split])
        ignored |= {(region, split): value for region, value in values.items()}
    rows.append(EditRow(run=IGNORED, scene="edited", psnr_db=ignored))
    shares: dict[tuple[str, Split], float] = {
        (region, split): _mean_share(masks[split], region) for region in REGIONS for split in TEST_SPLITS
    }
    return EditScores(scored=scored, shares=shares, rows=tuple(rows))


def _score_regions(run: Run, targets: dict[Split, Sequence[Image]], masks: dict[Split, list[Masks]]) -> RegionScores:
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


EDIT_VIEWS = 2
"""Views of each split on the sheet of an edit."""

EDIT_NOTE = (
    "Object: pixels that show a changed object in either scene. Light: other pixels where the truth changes by more "
    "than its noise. Unedited: the same pixels of the same run before the edit. Truth before the edit: what a perfect "
    "renderer that ignores the edit would score."
)


def edit_grids(title: str, edits: Sequence[EditScores], runs: Sequence[RunScores]) -> list[Grid]:
    """A table per edit: PSNR by region after and before the edit; means over seeds of `runs`, all of the scene."""
    return [_edit_grid(title, edit, runs, notes=(EDIT_NOTE, MEANS_NOTE) if edit is edits[-1] else ()) for edit in edits]


def _edit_grid(title: str, edit: EditScores, runs: Sequence[RunScores], *, notes: tuple[str, ...]) -> Grid:
    record = edit.edited.edit
    assert record is not None
    shares = ", ".join(
        f"{region} {' / '.join(f'{100 * edit.shares[region, split]:.1f}' for split in TEST_SPLITS)} %"
        for region in ("object", "light")
    )
    columns = [Column(group="run", is_number=False), Column(group="seeds"), Column(group="scene", is_number=False)]
    columns += [Column(group=f"{region} dB ↑", split=split) for region in REGIONS for split in TEST_SPLITS]
    scores = {(row.run, row.scene): row.psnr_db for row in edit.rows}
    rows = []
    for name, members in by_group(runs, {run: run for run, _ in scores}).items():
        for scene in ("edited", "unedited"):
            found = [scores[run, scene] for run in members]
            rows.append((name, str(len(found)), scene, *_decibels(found, REGIONS)))
    rows.append((IGNORED, "", "edited", *_decibels([scores[IGNORED, "edited"]], REGIONS)))
    return Grid(
        title=f"{title}, after {' then '.join(record.edits)} ({shares} of the pixels)",
        columns=tuple(columns),
        rows=tuple(rows),
        last_row_apart=True,
        notes=notes,
    )


def edit_json(edit: EditScores) -> dict[str, Json]:
    """The scores of the whole pictures, and those in regions beside them."""
    record = edit.edited.edit
    assert record is not None
    return {
        **variant_json(edit.scored),
        "edits": list(record.edits),
        "shares": _nested(edit.shares),
        "rows": [{"run": row.run, "scene": row.scene, "psnr_db": _nested(row.psnr_db)} for row in edit.rows],
    }


def _decibels(scores: Sequence[RegionScores], regions: Iterable[str]) -> tuple[str, ...]:
    """Means over the runs, region by region, of each split."""
    return tuple(
        format_number(mean_of([of_run.get((region, split)) for of_run in scores]), 2)
        for region in regions
        for split in TEST_SPLITS
    )


def _nested(scores: Mapping[tuple[str, Split], float | None]) -> Json:
    regions = dict.fromkeys(region for region, _ in scores)
    return {region: {split: value for (name, split), value in scores.items() if name == region} for region in regions}


def edit_sheet(scene: SceneScores, edit: EditScores) -> bytes:
    """The PNG of an edit: the truth before and after it and each run's prediction, in the views that show most of it.

    From runs that only differ in their seed, only the first is shown.
    """
    from eval.figures import Panel, Row, draw_sheet

    drawn = by_group(scene.runs, {run.name: run for run in edit.runs})
    runs = [members[0] for members in drawn.values()]
    rows = []
    for split in TEST_SPLITS:
        views = range(edit.edited.config.split(split).views)
        shares = [float(np.mean(read_edit_mask(edit.edited, split, view) == OBJECT)) for view in views]
        for view in sorted(sorted(views, key=lambda view: -shares[view])[:EDIT_VIEWS]):
            truths = [dataset.view(split, view).image for dataset in (scene.dataset, edit.edited)]
            panels = [Panel(image=image, caption=f"view {view_name(view)}") for image in truths]
            for run in runs:
                pred = read_prediction(run, split, view) if has_split(run, split) else None
                panels.append(Panel(image=pred, caption="" if pred is None else psnr_text(psnr(pred, truths[1]))))
            rows.append(Row(split=split, panels=tuple(panels)))
    heads = ("truth before", "truth after", *(run.name for run in runs))
    title = f"{scene.title}: {edit.edited.name}"
    return draw_sheet(title, heads, rows, size=scene.dataset.config.resolution)
