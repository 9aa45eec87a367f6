"""How a run was trained, as far as its folder tells: metrics.jsonl, one JSON object a line."""

from dataclasses import dataclass
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.reading import MAX_JSON_BYTES, parse_json, read_regular
from datagen.disk.storage import sha256
from datagen.pages.charts import Line, line_chart
from datagen.pages.html import Markup, join, tag

MOST_POINTS = 400
"""Points of a curve in a page; of more, an even selection."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """Curves by their name in the file: steps and values."""

    curves: dict[str, tuple[tuple[float, float], ...]]
    digest: str = ""
    """SHA-256 of the file."""
    is_damaged: bool = False
    """A line could not be read; the others were."""


def read_training(folder: Path) -> Training:
    """What a run's metrics.jsonl tells; nothing where there is none, as with foreign methods."""
    path = folder / "metrics.jsonl"
    curves: dict[str, list[tuple[float, float]]] = {}
    if not path.is_file():
        return Training(curves={})
    is_damaged = False
    try:
        data = read_regular(path, at_most=MAX_JSON_BYTES)
    except HyalineError:
        return Training(curves={}, is_damaged=True)
    for line in data.splitlines():
        try:
            record = parse_json(line, where=str(path))
        except HyalineError:  # A run that was killed may have left half a line.
            is_damaged = True
            continue
        step = record.pop("step", None)
        if isinstance(step, (int, float)):
            for key, value in record.items():
                if isinstance(value, (int, float)) and not isinstance(value, bool):
                    curves.setdefault(key, []).append((float(step), float(value)))
    return Training(
        curves={key: _thinned(points) for key, points in curves.items()}, digest=sha256(data), is_damaged=is_damaged
    )


def training_charts(training: Training) -> Markup:
    """A chart a curve."""
    charts = [
        line_chart([Line(name=name, points=points)], title=f"{name} by training step", x_title="step", y_title=name)
        for name, points in training.curves.items()
    ]
    damaged = tag("p", "A part of metrics.jsonl cannot be read.", class_="bad") if training.is_damaged else None
    if not charts:
        return join([damaged, tag("p", "The run's folder holds no training curves.", class_="note")])
    return join([damaged, tag("div", *charts, class_="views")])


def _thinned(points: list[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    every = -(-len(points) // MOST_POINTS)
    return tuple(points[::every])
