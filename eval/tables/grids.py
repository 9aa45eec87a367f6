"""Printed tables: for each scene one of scores, one of means over seeds and one that describes the runs."""

import math
from dataclasses import dataclass

from datagen.data.config import TEST_SPLITS, Split
from eval.score.scores import METRICS, Metric, RunScores, SceneScores
from eval.score.seeds import SeedGroup, group_seeds

MISSING = "–"  # noqa: RUF001  An en dash, as tables have it.
CEILING = "noise ceiling"
SHORT_SPLITS: dict[Split, str] = {
    "train": "train",
    "interpolating": "inter",
    "extrapolating": "extra",
    "extrapolating-10deg": "10°",
    "extrapolating-20deg": "20°",
    "extrapolating-40deg": "40°",
}
TABLE_WIDTH = 120

DROP = Metric(key="drop_db", title="drop dB ↓", decimals=2)
"""PSNR interpolating minus extrapolating; its best value is not marked."""

MEANS_NOTE = "Of runs that differ in their seed alone: means over the seeds."


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column's header; neighbours with the same group share it."""

    group: str
    split: Split | None = None
    is_number: bool = True


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table without formatting."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    last_row_apart: bool = False
    notes: tuple[str, ...] = ()
    best: frozenset[tuple[int, int]] = frozenset()
    """Row and column of the best values of their columns."""
    is_detail: bool = False
    """True for tables that are only printed with --full."""


def scene_grids(scene: SceneScores, *, is_wrapped: bool = False) -> tuple[Grid, ...]:
    """The scores of a scene's runs above the noise ceiling; means over seeds, if any; a description of the runs.

    Args:
        is_wrapped: include the metric of the paper's authors' script.
    """
    groups = [group for group in group_seeds(scene.runs) if len(group.runs) > 1]
    metrics = tuple(metric for metric in METRICS if metric.is_printed or (is_wrapped and metric.is_wrapped))
    seeds = [_seed_grid(scene, groups, metrics)] if groups else []
    return _score_grid(scene, metrics), *seeds, _run_grid(scene)


def format_number(value: float | None, decimals: int) -> str:
    if value is None:
        return MISSING
    return "∞" if math.isinf(value) else f"{value:.{decimals}f}"


def ceiling_text(value: float | None) -> str:
    """A noise ceiling in dB; unknown for imported pictures."""
    return "unknown" if value is None else format_number(value, 2)


def psnr_text(value: float | None) -> str:
    """The PSNR of one picture for its caption; empty if it has none."""
    if value is None:
        return ""
    return "PSNR ∞ (identical)" if math.isinf(value) else f"PSNR {value:.2f} dB"


def _score_columns(metrics: tuple[Metric, ...]) -> list[tuple[Column, Metric]]:
    """Each metric on both splits; after PSNR, its drop from one split to the other."""
    columns: list[tuple[Column, Metric]] = []
    for metric in metrics:
        columns += [(Column(group=metric.title, split=split), metric) for split in TEST_SPLITS]
        columns += [(Column(group=DROP.title), DROP)] if metric.key == "psnr_db" else []
    return columns


def _score_grid(scene: SceneScores, metrics: tuple[Metric, ...]) -> Grid:
    """The best run first, by its PSNR on the interpolating split."""
    columns, runs = _score_columns(metrics), sorted(scene.runs, key=_rank)
    values = [
        [run.drop_db if column.split is None else run.mean(metric.key, column.split) for column, metric in columns]
        for run in runs
    ]
    decimals = [metric.decimals for _, metric in columns]
    signs = [0 if metric is DROP or len(runs) < 2 else metric.sign for _, metric in columns]
    rows = [(run.run.name, *map(format_number, line, decimals)) for run, line in zip(runs, values, strict=True)]
    ceiling = [ceiling_text(scene.ceilings_db[split]) for split in TEST_SPLITS]
    rest = [MISSING] * (len(columns) - len(ceiling))
    views = " + ".join(f"{scene.dataset.config.split(split).views} {split}" for split in TEST_SPLITS)
    return Grid(
        title=f"{scene.title}: {views} views of {scene.dataset.config.resolution} pixels",
        columns=(Column(group="run", is_number=False), *(column for column, _ in columns)),
        rows=(*rows, (CEILING, *ceiling, *rest)),
        last_row_apart=True,
        notes=left_out_notes(scene),
        best=_best(rows, values, signs),
    )


def _rank(scores: RunScores) -> tuple[float, str]:
    mean = scores.mean("psnr_db", "interpolating")
    return (math.inf if mean is None else -mean, scores.run.name)


def _best(
    rows: list[tuple[str, ...]], values: list[list[float | None]], signs: list[int]
) -> frozenset[tuple[int, int]]:
    """The places of each score's best value, and of values printed equally; the first column has names."""
    best = set()
    for place, sign in enumerate(signs):
        known = [(sign * value, row) for row, line in enumerate(values) if (value := line[place]) is not None]
        if sign and known:
            text = rows[max(known)[1]][place + 1]
            best |= {(row, place + 1) for row, line in enumerate(rows) if line[place + 1] == text}
    return frozenset(best)


def _seed_grid(scene: SceneScores, groups: list[SeedGroup], metrics: tuple[Metric, ...]) -> Grid:
    """Two lines per group: the mean of its runs' scores, and their standard deviation."""
    columns = _score_columns(metrics)
    decimals = [metric.decimals for _, metric in columns]
    rows = []
    for group in groups:
        spreads = [
            group.drop_db if column.split is None else group.score(metric.key, column.split)
            for column, metric in columns
        ]
        means = map(format_number, [value.mean for value in spreads], decimals)
        rows.append((group.name, str(len(group.runs)), *means))
        rows.append(("  ±", "", *map(format_number, [value.deviation for value in spreads], decimals)))
    return Grid(
        title=f"{scene.title}: mean and standard deviation over seeds",
        columns=(Column(group="runs", is_number=False), Column(group="seeds"), *(column for column, _ in columns)),
        rows=tuple(rows),
        notes=("Each run's score is as in the table above; ± is the sample standard deviation (n - 1) over seeds.",),
    )


def _run_grid(scene: SceneScores) -> Grid:
    texts = ("run", "method", "label", "geometry", "knowledge")
    return Grid(
        title=f"{scene.title}: the runs",
        columns=(
            *(Column(group=text, is_number=False) for text in texts),
            Column(group="parameters"),
            Column(group="seed"),
        ),
        rows=tuple(_run_row(scores) for scores in scene.runs),
        notes=(f"Data: dataset {scene.dataset.seal[:12]}.",),
        is_detail=True,
    )


def _run_row(scores: RunScores) -> tuple[str, ...]:
    run = scores.run
    texts = (run.method, run.label, run.geometry, run.knowledge)
    return (
        run.name,
        *(text or MISSING for text in texts),
        MISSING if run.num_parameters is None else f"{run.num_parameters:,}",
        MISSING if run.seed is None else str(run.seed),
    )


def left_out_notes(scene: SceneScores) -> tuple[str, ...]:
    """Which means do not cover all pictures, and why."""
    notes = [] if scene.has_glass_mask else ["PSNR glass: needs layers of the true geometry to find glass pixels."]
    for scores in scene.runs:
        for split, values in scores.splits.items():
            if values is None:
                notes.append(f"{scores.run.name}: has no predictions for the {split} split.")
                continue
            total = len(values.images["psnr_db"])
            for metric in METRICS:
                if count := values.identical(metric.key):
                    title = metric.title.removesuffix(" ↑")
                    notes.append(
                        f"{scores.run.name}, {split}: {title} is infinite in {count} of {total} pictures, left out."
                    )
    for split, count in _without_glass(scene).items():
        notes.append(f"{split}: {count} of the pictures show no glass and are left out of PSNR glass.")
    return tuple(notes)


def _without_glass(scene: SceneScores) -> dict[Split, int]:
    counts: dict[Split, int] = {}
    for scores in scene.runs:
        for split, values in scores.splits.items():
            if scene.has_glass_mask and values is not None and (count := values.undefined("glass_psnr_db")):
                counts[split] = count
    return counts
