"""The tables of edits, what results.json says of them, and the picture sheet of each."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.paths import view_name
from datagen.data.variants import OBJECT, read_edit_mask
from datagen.disk.records import Json
from eval.analyses.edits import IGNORED, REGIONS, EditScores, RegionScores
from eval.analyses.variants import variant_json
from eval.score.metrics import mean_of, psnr
from eval.score.runs import has_split, read_prediction
from eval.score.scores import RunScores, SceneScores
from eval.score.seeds import by_group
from eval.tables.grids import MEANS_NOTE, Column, Grid, format_number, psnr_text
from eval.tables.results import json_number

EDIT_VIEWS = 2
"""Views of each split on the sheet of an edit."""

EDIT_NOTE = (
    "Object: pixels that show a changed object in either scene. Light: other pixels where the truth changes by more "
    "than its noise. Unedited: the same pixels of the same run before the edit. Truth before the edit: what a perfect "
    "renderer that ignores the edit would score."
)


def edit_grids(title: str, edits: Sequence[EditScores], runs: Sequence[RunScores]) -> list[Grid]:
    """For each edit PSNR by region, with the scores before the edit below those after it; means over seeds of `runs`,
    all of the scene."""
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
    return {
        region: {split: json_number(value) for (name, split), value in scores.items() if name == region}
        for region in regions
    }


def edit_sheet(scene: SceneScores, edit: EditScores) -> bytes:
    """The PNG of an edit: the truth before and after it, and what each run drew (of runs that differ in their seed
    alone, the first one), in the views that show most of it."""
    from eval.figures.sheets import Panel, Row, draw_sheet

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
