"""Owns the tables of edits and of order, and what results.json says of them."""

from collections.abc import Mapping

from datagen.dataset import TEST_SPLITS, Split
from datagen.records import Json
from eval.edits import REGIONS, EditScores
from eval.order import OrderScores
from eval.regions import RegionScores
from eval.results import json_number
from eval.tables import Column, Grid, format_number

EDIT_NOTE = (
    "Object: pixels that show a changed object in either scene. Light: other pixels where the truth changes by more "
    "than its noise. Unedited: the same pixels of the same run before the edit. Truth before the edit: what a perfect "
    "renderer that ignores the edit would score."
)


def edit_grids(title: str, edits: tuple[EditScores, ...]) -> list[Grid]:
    """For each edit PSNR by region, with each run's scores before the edit below those after it."""
    return [_edit_grid(title, edit, notes=(EDIT_NOTE,) if edit is edits[-1] else ()) for edit in edits]


def _edit_grid(title: str, edit: EditScores, *, notes: tuple[str, ...]) -> Grid:
    record = edit.edited.edit
    assert record is not None
    shares = ", ".join(
        f"{region} {' / '.join(f'{100 * edit.shares[region, split]:.1f}' for split in TEST_SPLITS)} %"
        for region in ("object", "light")
    )
    columns = [Column(group=head, is_number=False) for head in ("run", "scene")]
    columns += [Column(group=f"{region} dB ↑", split=split) for region in REGIONS for split in TEST_SPLITS]
    rows = tuple(
        (row.run, row.scene, *(_decibels(row.psnr_db, region, split) for region in REGIONS for split in TEST_SPLITS))
        for row in edit.rows
    )
    return Grid(
        title=f"{title}, after {' then '.join(record.edits)} ({shares} of the pixels)",
        columns=tuple(columns),
        rows=rows,
        last_row_apart=True,
        notes=notes,
    )


def order_grid(title: str, order: OrderScores) -> Grid:
    """PSNR on pixels whose order of surfaces training has shown, and on those where it is new."""
    columns = [Column(group=head, is_number=False) for head in ("scene", "run")]
    columns += [Column(group=f"{region} dB ↑", split=split) for region in ("seen", "new") for split in TEST_SPLITS]
    columns += [Column(group="new %", split=split) for split in TEST_SPLITS]
    rows = tuple(
        (
            row.scene,
            row.run,
            *(_decibels(row.psnr_db, region, split) for region in ("seen", "new") for split in TEST_SPLITS),
            *(f"{100 * row.new_share[split]:.2f}" for split in TEST_SPLITS),
        )
        for row in order.rows
    )
    return Grid(
        title=f"{title}: PSNR by order of the first {order.num_layers} layers",
        columns=tuple(columns),
        rows=rows,
        notes=("New: pixels whose sequence of objects along the centre ray no training pixel has.",),
    )


def edit_json(edit: EditScores) -> Json:
    record = edit.edited.edit
    assert record is not None
    return {
        "edits": list(record.edits),
        "dataset_seal": edit.edited.seal,
        "shares": _nested(edit.shares),
        "rows": [{"run": row.run, "scene": row.scene, "psnr_db": _nested(row.psnr_db)} for row in edit.rows],
    }


def order_json(order: OrderScores) -> Json:
    return {
        "num_layers": order.num_layers,
        "rows": [
            {
                "scene": row.scene,
                "run": row.run,
                "psnr_db": _nested(row.psnr_db),
                "new_share": {split: row.new_share[split] for split in TEST_SPLITS},
            }
            for row in order.rows
        ],
    }


def _decibels(scores: RegionScores, region: str, split: Split) -> str:
    return format_number(scores.get((region, split)), 2)


def _nested(scores: Mapping[tuple[str, Split], float | None]) -> Json:
    regions = dict.fromkeys(region for region, _ in scores)
    return {
        region: {split: json_number(value) for (name, split), value in scores.items() if name == region}
        for region in regions
    }
