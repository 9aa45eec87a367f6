"""Tables of scores from the content of results.json: of a scene's runs and variants."""

import math
from collections.abc import Callable, Sequence
from typing import Any, cast

from datagen.data.config import TEST_SPLITS, Resolution, Split
from eval.score.scores import METRICS, Metric, Spread, name_of_seeds, spread
from eval.tables.grids import CEILING, MISSING, Column, Grid, ceiling_text, format_number

Stored = dict[str, Any]
"""A part of results.json."""


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
        notes=(f"Data: dataset seal {scene['dataset_seal'][:12]}.",) if is_page else tuple(scene["notes"]),
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
