"""How a run was trained, as far as its folder tells: metrics.jsonl, one JSON object a line, and costs.json."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeGuard

from datagen.disk.errors import HyalineError
from datagen.disk.reading import MAX_JSON_BYTES, parse_json, read_regular
from datagen.disk.storage import sha256
from datagen.pages.charts import Line, line_chart
from datagen.pages.document import definitions
from datagen.pages.html import Markup, join, tag

HELD_OUT = "held_out_psnr"
TITLES = {"loss": ("Training loss", "loss"), HELD_OUT: ("PSNR on held-out views", "PSNR (dB)")}
"""Of a curve and of its axis. Other methods' curves keep their names."""
MOST_POINTS = 400
"""Points of a curve in a page; of more, an even selection."""


Points = tuple[tuple[float, float], ...]


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
