"""The scores as data, results.json with every picture's value, and the tables that are made of it."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

from datagen.data.config import TEST_SPLITS, Resolution, Split
from datagen.disk.records import Json
from eval.score.runs import read_costs
from eval.score.scores import (
    METRIC_NOTES,
    METRICS,
    WRAPPED_NOTE,
    Metric,
    RunScores,
    SceneScores,
    SeedGroup,
    SplitScores,
    Spread,
    describe_run,
    group_seeds,
    name_of_seeds,
    spread,
)
from eval.tables.grids import CEILING, MISSING, Column, Grid, ceiling_text, format_number

RESULTS_VERSION = 1
KNOWN = ("method", "label", "geometry", "knowledge", "num_parameters", "seed")
"""What a run's record tells."""

Stored = dict[str, Any]
"""A part of results.json."""


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
    """Which means do not cover all pictures, and why; runs without a loss of their method."""
    notes: dict[str, None] = {}  # Once each.
    if not scene.has_glass_mask:
        notes["PSNR glass: needs layers of the true geometry to find glass pixels."] = None
    for scores in scene.runs:
        if (scores.run.record.flags or {}).get("vgg-weights") == "none":
            notes[f"{scores.run.name}: learned by L1 alone, without the perceptual loss of its method."] = None
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


# Tables from the content of results.json


def scene_grids(scene: Stored, *, is_page: bool = False) -> list[Grid]:
    """The scores of a scene's runs above the noise ceiling, then those of each variant that they predicted.

    Args:
        is_page: for a page of results, with what the runs know.
    """
    runs = {run["run"]: run for run in scene["runs"]}
    counts = {name: run["num_parameters"] for name, run in runs.items()}
    texts: dict[str, Callable[[str], str]] = {
        "knows": lambda name: runs[name]["knowledge"] or MISSING,
        "parameters": lambda name: MISSING if counts[name] is None else f"{counts[name]:,}",
    }
    minutes = {name: run["cpu_seconds"] / 60 for name, run in runs.items() if run.get("cpu_seconds")}
    drops = {name: run["drop_db"] for name, run in runs.items()}
    scores = _grid(
        f"{scene['scene']}: {_size(scene)}",
        _groups(scene),
        {name: run["splits"] for name, run in runs.items()},
        TEST_SPLITS,
        scene["noise_ceiling_db"],
        tuple(metric for metric in METRICS if metric.is_printed),
        texts if is_page else {},
        {"drop dB ↓": drops, **({"CPU min": minutes} if minutes else {})},
        notes=(f"Data: dataset digest {scene['dataset_seal'][:12]}.",) if is_page else tuple(scene["notes"]),
    )
    return [scores, *(_variant_grid(scene, *item) for item in scene["analyses"].get("variants", {}).items())]


def _variant_grid(scene: Stored, name: str, variant: Stored) -> Grid:
    known = [drawn for group in _groups(scene) if (drawn := [run for run in group if run in variant["runs"]])]
    splits = tuple(cast(Sequence[Split], variant["noise_ceiling_db"]))
    metrics = tuple(metric for metric in METRICS if metric.in_db and metric.is_printed)
    title = f"{scene['scene']}: variant {name}"
    return _grid(title, known, variant["runs"], splits, variant["noise_ceiling_db"], metrics, {}, {})


def _size(scene: Stored) -> str:
    scored = [scores for run in scene["runs"] for scores in run["splits"].values() if scores]
    counts = sorted({len(scores[METRICS[0].key]["pictures"]) for scores in scored})
    return f"{Resolution(**scene['resolution'])} pixels, {' or '.join(map(str, counts))} views of each test split"


def _groups(scene: Stored) -> list[list[str]]:
    """The names of runs, grouped if they only differ in their seed."""
    together: list[list[str]] = [group["runs"] for group in scene["seeds"]]
    grouped = {name for group in together for name in group}
    return together + [[run["run"]] for run in scene["runs"] if run["run"] not in grouped]


def _grid(
    title: str,
    groups: list[list[str]],
    runs: Stored,
    splits: Sequence[Split],
    ceilings: Stored,
    metrics: Sequence[Metric],
    texts: dict[str, Callable[[str], str]],
    numbers: dict[str, Stored],
    notes: tuple[str, ...] = (),
) -> Grid:
    """One table, the best run first, by its PSNR on the first split.

    Args:
        runs: splits with their metrics and means, by the run's name.
        texts: further columns before the scores.
        numbers: further columns after them, with one number per run.
    """
    scored = [(metric, split) for metric in metrics for split in splits]
    table = [
        (group, [spread([_mean(runs[name].get(split), metric.key) for name in group]) for metric, split in scored])
        for group in groups
    ]
    table.sort(key=lambda row: -math.inf if row[1][0].mean is None else row[1][0].mean, reverse=True)
    first = len(texts) + 2
    best = set()
    for place, (metric, _) in enumerate(scored):
        means = [scores[place].mean for _, scores in table]
        values = {row: metric.sign * mean for row, mean in enumerate(means) if mean is not None}
        if metric.sign and len(values) > 1:
            best |= {(row, first + place) for row, value in values.items() if value == max(values.values())}
    rows = [
        (
            name_of_seeds(group),
            *(text(group[0]) for text in texts.values()),
            str(len(group)),
            *(_cell(score, metric.decimals) for score, (metric, _) in zip(scores, scored, strict=True)),
            *(_cell(spread([_number(number.get(name)) for name in group]), 2) for number in numbers.values()),
        )
        for group, scores in table
    ]
    ceiling = (ceiling_text(_number(ceilings.get(split))) for split in splits)
    rest = len(scored) - len(splits) + len(numbers)
    return Grid(
        title=title,
        columns=(
            *(Column(group=name, is_number=False) for name in ["run", *texts]),
            Column(group="seeds"),
            *(Column(group=metric.title, split=split) for metric in metrics for split in splits),
            *(Column(group=name) for name in numbers),
        ),
        rows=(*rows, (CEILING, *[""] * (len(texts) + 1), *ceiling, *[""] * rest)),
        last_row_apart=True,
        best=frozenset(best),
        notes=notes,
    )


def _mean(metrics: Stored | None, key: str) -> float | None:
    return None if metrics is None else _number(metrics[key]["mean"])


def _number(value: float | str | None) -> float | None:
    return math.inf if value == "inf" else cast(float | None, value)


def _cell(value: Spread, decimals: int) -> str:
    mean = format_number(value.mean, decimals)
    return mean if value.deviation is None else f"{mean} ± {format_number(value.deviation, decimals)}"
