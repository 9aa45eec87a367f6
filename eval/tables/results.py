"""The scores as data: results.json with every picture's value, and CSV with one line per run."""

import csv
import dataclasses
import io
import math
from collections.abc import Mapping
from typing import cast

from datagen.data.config import TEST_SPLITS, Split
from datagen.disk.records import Json
from eval.score.runs import read_costs
from eval.score.scores import (
    METRIC_NOTES,
    METRICS,
    WRAPPED_NOTE,
    RunScores,
    SceneScores,
    SeedGroup,
    SplitScores,
    describe_run,
    group_seeds,
)
from eval.tables.grids import CEILING, Grid
from eval.tables.scenes import Stored

RESULTS_VERSION = 1
KNOWN = ("method", "label", "geometry", "knowledge", "num_parameters", "seed")
"""What a run's record tells."""

Cell = str | int | None


def results_data(
    scenes: list[SceneScores],
    analyses: Mapping[str, dict[str, Json]] | None = None,
    more: Mapping[str, Json] | None = None,
) -> Stored:
    """The content of results.json. Infinite values are the string "inf", because JSON has no such number.

    Args:
        analyses: results of the analyses, by the scene's title.
        more: further top-level entries.
    """
    results: dict[str, Json] = {
        "version": RESULTS_VERSION,
        "notes": [*METRIC_NOTES, WRAPPED_NOTE],
        "scenes": [_scene_json(scene, (analyses or {}).get(scene.title, {})) for scene in scenes],
        **(more or {}),
    }
    return {key: _finite(value) for key, value in results.items()}


def results_csv(scenes: list[SceneScores]) -> str:
    """One line per run, one per scene for the noise ceiling; empty if not computed."""
    scored = [f"{metric.key}_{split}" for metric in METRICS for split in TEST_SPLITS]
    buffer = io.StringIO()
    table = csv.DictWriter(
        buffer,
        ["scene", "run", *KNOWN, *scored, "drop_db", "dataset_seal", "predictions_sha256", "config_sha256"],
        lineterminator="\n",
    )
    table.writeheader()
    for scene in scenes:
        place = {"scene": csv_text(scene.title), "dataset_seal": scene.dataset.seal}
        for scores in scene.runs:
            means = {f"{m.key}_{split}": scores.mean(m.key, split) for m in METRICS for split in TEST_SPLITS}
            about = {key: csv_text(getattr(scores.run.record, key)) for key in KNOWN}
            last = {
                "drop_db": scores.drop_db,
                "predictions_sha256": scores.predictions_sha256,
                "config_sha256": describe_run(scores.run),
            }
            table.writerow({**place, "run": csv_text(scores.run.name), **about, **means, **last})
        ceilings = {f"psnr_db_{split}": scene.ceilings_db[split] for split in TEST_SPLITS}
        table.writerow({**place, "run": CEILING, **ceilings})
    return buffer.getvalue()


def csv_text(value: Cell) -> Cell:
    """A cell that is not a formula for spreadsheets: text that starts like one gets an apostrophe."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@")) else value


def _scene_json(scene: SceneScores, analyses: dict[str, Json]) -> Json:
    return {
        "scene": scene.title,
        "dataset_seal": scene.dataset.seal,
        "preset": scene.dataset.config.preset,
        "resolution": dataclasses.asdict(scene.dataset.config.resolution),
        "splits": {split: dataclasses.asdict(scene.dataset.config.split(split)) for split in scene.dataset.splits},
        "noise_ceiling_db": {split: scene.ceilings_db[split] for split in TEST_SPLITS},
        "notes": _left_out_notes(scene),
        "runs": [_run_json(scores) for scores in scene.runs],
        "seeds": [_group_json(group) for group in group_seeds(scene.runs) if len(group.runs) > 1],
        "analyses": analyses,
    }


def _left_out_notes(scene: SceneScores) -> list[Json]:
    """Which means do not cover all pictures, and why."""
    notes: dict[str, None] = {}  # Once each.
    if not scene.has_glass_mask:
        notes["PSNR glass: needs layers of the true geometry to find glass pixels."] = None
    for scores in scene.runs:
        for split, values in scores.splits.items():
            if values is None:
                notes[f"{scores.run.name}: has no predictions for the {split} split."] = None
                continue
            total = len(values.images["psnr_db"])
            for metric in METRICS:
                if count := values.identical(metric.key):
                    what = f"{metric.title.removesuffix(' ↑')} is infinite in {count} of {total} pictures, left out."
                    notes[f"{scores.run.name}, {split}: {what}"] = None
            if scene.has_glass_mask and (count := values.undefined("glass_psnr_db")):
                notes[f"{split}: {count} of the pictures show no glass and are left out of PSNR glass."] = None
    return [*notes]


def _group_json(group: SeedGroup) -> Json:
    spreads = {f"{m.key}_{split}": group.score(m.key, split) for m in METRICS for split in TEST_SPLITS}
    spreads["drop_db"] = group.drop_db
    return {
        "runs": [scores.run.name for scores in group.runs],
        "config_sha256": describe_run(group.first),
        "scores": {key: {"mean": value.mean, "deviation": value.deviation} for key, value in spreads.items()},
    }


def _run_json(scores: RunScores) -> Json:
    run = scores.run
    return {
        "run": run.name,
        **{key: getattr(run.record, key) for key in KNOWN},
        "config_sha256": describe_run(run),
        "predictions_sha256": scores.predictions_sha256,
        "cpu_seconds": cast(Json, read_costs(run.folder).get("cpu_seconds")),
        "drop_db": cast(Json, scores.drop_db),
        "splits": splits_json(scores.splits),
    }


def _finite(data: Json) -> Json:
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_finite(value) for value in data]
    return "inf" if isinstance(data, float) and math.isinf(data) else data


def splits_json(splits: Mapping[Split, SplitScores | None]) -> Json:
    """By split and metric: the mean, and each picture's value."""
    return {
        split: None
        if values is None
        else {key: {"mean": values.mean(key), "pictures": list(images)} for key, images in values.images.items()}
        for split, values in splits.items()
    }


def grid_json(grid: Grid) -> Json:
    """A table for results.json."""
    return {
        "title": grid.title,
        "columns": [[column.group, column.split, column.is_number] for column in grid.columns],
        "rows": [list(row) for row in grid.rows],
        "notes": list(grid.notes),
    }
