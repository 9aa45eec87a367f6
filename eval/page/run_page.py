"""The page of one run: its pictures, its training, what it was told, and how to make it again.

How it was trained is known as far as its folder tells: metrics.jsonl, one JSON object a line, and costs.json.
"""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeGuard

from datagen.disk.errors import HyalineError
from datagen.disk.reading import MAX_JSON_BYTES, parse_json, read_regular
from datagen.disk.records import Json
from datagen.disk.storage import sha256
from datagen.pages.charts import Line, line_chart
from datagen.pages.html import Markup, Part, anchor, command, definitions, join, prose, section, tag
from datagen.pages.pictures import Gallery
from eval.page.views import Compared, ShownView, draw_views
from eval.score.runs import Run
from eval.score.scores import METRICS, RunScores, SceneScores
from eval.tables.grids import Column, Grid, format_number
from eval.tables.looks import html_table

HELD_OUT = "held_out_psnr"
TITLES = {"loss": ("Training loss", "loss"), HELD_OUT: ("PSNR on held-out views", "PSNR (dB)")}
"""Of a curve and of its axis. Other methods' curves keep their names."""
MOST_POINTS = 400
"""Points of a curve in a page; of more, an even selection."""


Points = tuple[tuple[float, float], ...]


def run_anchor(scene: SceneScores, run: Run) -> str:
    """Where in the page a run stands."""
    return anchor("run", scene.title, run.folder.parent.name, run.name)


def run_page(
    scene: SceneScores, scores: RunScores, views: Mapping[Compared, Sequence[ShownView]], gallery: Gallery
) -> Markup:
    """Everything that is known of one run.

    Args:
        views: those to show of each split that it predicted.
    """
    run, place = scores.run, run_anchor(scene, scores.run)
    pictures: list[Part] = [
        join(
            [
                tag("h3", item.title, _mean_psnr(item)),
                draw_views(gallery, item, shown),
                _how_many(item, len(shown)),
                _every_picture(item),
            ]
        )
        for item, shown in views.items()
    ]
    parts: list[Part] = [
        tag("p", "On ", scene.title, class_="note"),
        *pictures,
        tag("h3", "Training"),
        training_charts(read_training(run.folder), _training_ceiling_db(run)),
        tag("h3", "What it was told"),
        definitions(_facts(scores)),
        tag("h3", "Make it again"),
        _how_to_make(run),
    ]
    return tag("div", section(run.name, *parts, id_=place), class_="page", id=f"{place}-page")


def _how_many(item: Compared, shown: int) -> Markup | None:
    count = len(item.scores.images["psnr_db"])
    if shown == count:
        return None
    more = prose(f"{shown} of {count} views; `eval report --views {count}` shows as many as find room.")
    return tag("p", more, class_="note")


def _training_ceiling_db(run: Run) -> float | None:
    """None where nobody knows, or training views are not there any more."""
    try:
        return run.dataset.noise_ceiling_db("train")
    except HyalineError:
        return None


def _every_picture(item: Compared) -> Markup:
    return tag("details", tag("summary", f"Every picture of {item.title}"), html_table(every_picture_grid(item)))


def every_picture_grid(item: Compared) -> Grid:
    """Every metric of every picture of a split."""
    metrics = [metric for metric in METRICS if metric.is_printed]
    views = range(len(item.scores.images[metrics[0].key]))
    return Grid(
        title=f"{item.title}: every picture",
        columns=(Column(group="view"), *(Column(group=metric.title) for metric in metrics)),
        rows=tuple(
            (str(view), *(format_number(item.scores.images[m.key][view], m.decimals) for m in metrics))
            for view in views
        ),
    )


def _mean_psnr(item: Compared) -> str:
    mean = item.scores.mean("psnr_db")
    return f": {format_number(mean, 2)} dB" + (" in the mean" if len(item.scores.images["psnr_db"]) > 1 else "")


def _facts(scores: RunScores) -> list[tuple[str, Part]]:
    run = scores.run
    known: list[tuple[str, Part]] = [
        ("method", run.method),
        ("label", run.label),
        ("knows", run.knowledge),
        ("geometry", run.geometry),
        ("layers", run.num_layers),
        ("parameters", None if run.num_parameters is None else f"{run.num_parameters:,}"),
        ("seed", run.seed),
        ("dataset", run.dataset.seal[:12]),
        ("predictions", scores.predictions_sha256[:12]),
    ]
    return [(term, value if value is not None else "not told") for term, value in known]


def _how_to_make(run: Run) -> Markup:
    if run.method is None or run.config is None:
        return tag("p", "A foreign method's pictures: its folder does not tell how they were made.", class_="note")
    words = ["model", "train", run.method, "--dataset", f"data/{run.dataset.name}"]
    choices = definitions([(key, value) for key, value in flattened(run.config)])
    if run.flags is None:
        words += [] if run.geometry in (None, "truth") else ["--geometry", run.geometry]
        words += [] if not run.seed else ["--seed", str(run.seed)]
        note = tag("p", "With the parameters below, where they are not the method's defaults.", class_="note")
    else:
        words += run.flags
        note = None
    return join([command(shlex.join(words)), note, tag("details", tag("summary", "All parameters"), choices)])


def flattened(config: Mapping[str, Json], above: str = "") -> list[tuple[str, str]]:
    """Every choice by its path, such as `net.branches`."""
    choices: list[tuple[str, str]] = []
    for key, value in config.items():
        if isinstance(value, dict):
            choices += flattened(value, f"{above}{key}.")
        elif key != "type":
            choices.append((f"{above}{key}", value if isinstance(value, str) else json.dumps(value)))
    return choices


@dataclass(frozen=True, kw_only=True)
class Training:
    """Curves by their name in the file: steps and values."""

    curves: dict[str, Points]
    costs: Mapping[str, float] = field(default_factory=dict)
    """Seconds and bytes by their name in the file."""
    digest: str = ""
    """SHA-256 of both files."""
    is_damaged: bool = False
    """A line could not be read; the others were."""


def read_training(folder: Path) -> Training:
    """What a run's files tell; nothing where there are none, as with foreign methods."""
    path = folder / "metrics.jsonl"
    curves: dict[str, list[tuple[float, float]]] = {}
    costs = _read_costs(folder / "costs.json")
    told = json.dumps(costs, sort_keys=True).encode() if costs else b""
    if not path.is_file():
        return Training(curves={}, costs=costs, digest=sha256(told) if told else "")
    is_damaged = False
    try:
        data = read_regular(path, at_most=MAX_JSON_BYTES)
    except HyalineError:
        return Training(curves={}, costs=costs, is_damaged=True)
    for line in data.splitlines():
        try:
            record = parse_json(line, where=str(path))
        except HyalineError:  # A run that was killed may have left half a line.
            is_damaged = True
            continue
        step = record.pop("step", None)
        if isinstance(step, (int, float)):
            for key, value in record.items():
                if _is_number(value):
                    curves.setdefault(key, []).append((float(step), float(value)))
    return Training(
        curves={key: _thinned(points) for key, points in curves.items()},
        costs=costs,
        digest=sha256(data + told),
        is_damaged=is_damaged,
    )


def _read_costs(path: Path) -> dict[str, float]:
    """The numbers of a file; none where it is not there or cannot be read."""
    if not path.is_file():
        return {}
    try:
        found = parse_json(read_regular(path, at_most=MAX_JSON_BYTES), where=str(path))
    except HyalineError:
        return {}
    return {key: float(value) for key, value in found.items() if _is_number(value) and float(value) >= 0}


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def describe_costs(training: Training) -> list[tuple[str, str]]:
    """What training took, in words."""
    known = training.costs
    described = {
        "time": _duration(known["seconds"]) if "seconds" in known else None,
        "processor time": _duration(known["cpu_seconds"]) if "cpu_seconds" in known else None,
        "memory, at most": _memory(known, "peak_memory_bytes"),
        "GPU memory, at most": _memory(known, "peak_gpu_memory_bytes"),
    }
    return [(term, value) for term, value in described.items() if value is not None]


def _memory(known: Mapping[str, float], name: str) -> str | None:
    return f"{known[name] / 1e6:,.0f} MB" if name in known else None


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def training_charts(training: Training, held_out_ceiling_db: float | None = None) -> Markup:
    """What it took, and a chart a curve.

    Args:
        held_out_ceiling_db: PSNR at which the noise of the training views stops a perfect method, where that is known.
    """
    costs = definitions([*describe_costs(training)]) if training.costs else None
    charts = [_chart(key, points, held_out_ceiling_db) for key, points in training.curves.items()]
    damaged = tag("p", "A part of metrics.jsonl cannot be read.", class_="bad") if training.is_damaged else None
    if not charts:
        return join([costs, damaged, tag("p", "The run's folder holds no training curves.", class_="note")])
    return join([costs, damaged, tag("div", *charts, class_="charts")])


def _chart(key: str, points: Points, ceiling_db: float | None) -> Markup:
    title, y_title = TITLES.get(key, (key.replace("_", " "), key.replace("_", " ")))
    lines, note = [Line(name=title, points=points)], None
    if key == HELD_OUT:
        why = "than test views"
        if ceiling_db is not None:
            why += f": their noise alone stops a perfect method at {ceiling_db:.1f} dB"
            lines.append(
                Line(name="noise of training views", points=((points[0][0], ceiling_db), (points[-1][0], ceiling_db)))
            )
        note = tag(
            "p",
            "Held-out views are training views that are not trained on. They measure progress, and do not compare with "
            f"the scores on test views: they are drawn with one ray a pixel, and are noisier {why}.",
            class_="note",
        )
    chart = line_chart(tuple(lines), title=f"{title} by training step", x_title="step", y_title=y_title)
    return tag("div", chart, note)


def _thinned(points: list[tuple[float, float]]) -> Points:
    every = -(-len(points) // MOST_POINTS)
    return tuple(points[::every])
