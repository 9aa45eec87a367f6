"""RESULTS.md: the tables of stored results.json files as one page of Markdown."""

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

from datagen.data.config import TEST_SPLITS, Resolution, Split
from datagen.disk.errors import HyalineError
from datagen.disk.reading import load_json
from datagen.disk.records import shown
from eval.score.scores import METRICS, Metric, metric_notes
from eval.score.seeds import Spread, spread
from eval.tables.grids import CEILING, MISSING, TABLE_WIDTH, Column, Grid, ceiling_text, format_number
from eval.tables.looks import grid_text, markdown_escaped
from eval.tables.results import RESULTS_VERSION

HEAD = """# Results

Every table comes from a `results.json` that `eval report` wrote, stored in [docs/results](docs/results). To add one, \
copy it there and run `make results`, which writes this page. What earlier versions of hyaline measured, and what was \
tried, stands in the notes: [history](docs/notes/history.md), [speed](docs/notes/speed.md).
"""

NOTES = (
    "dB per 10°: how PSNR falls with the angle between a test ray and the nearest training ray that met its texel. ±: "
    "sample standard deviation over seeds.",
)

Stored = dict[str, Any]
"""A part of results.json."""


def results_page(paths: Sequence[Path]) -> str:
    """The page: a section a file, in the order of their names.

    Raises:
        HyalineError: a file that `eval report` has not written, or of another version.
    """
    notes = "".join(f"\n{markdown_escaped(note)}\n" for note in (*metric_notes(is_wrapped=False), *NOTES))
    return HEAD + notes + "".join(_section(path) for path in sorted(paths, key=lambda path: path.name))


def _section(path: Path) -> str:
    data = cast(Stored, load_json(path))
    if data.get("version") != RESULTS_VERSION:
        raise HyalineError(
            f"{path}: format version {shown(data.get('version'))}; this program reads {RESULTS_VERSION}, as "
            "`eval report` writes it"
        )
    try:
        made_by = data.get("made_by", {})
        command, code = (made_by.get(key, "not recorded") for key in ("command", "code"))
        tables = [grid_text(grid, "markdown", width=TABLE_WIDTH) for scene in data["scenes"] for grid in _grids(scene)]
    except (AttributeError, KeyError, TypeError) as error:
        raise HyalineError(f"{path}: lacks {error}; expected a results.json that `eval report` wrote") from error
    about = f"[{path.name}]({path.as_posix()}); hyaline {code}."
    return "\n".join([f"\n## {path.stem}\n", f"```\n{command}\n```\n", f"{about}\n", *tables])


def _grids(scene: Stored) -> list[Grid]:
    """The scores of a scene, then of each variant that its runs drew."""
    groups = _groups(scene)
    size = f"{Resolution(**scene['resolution'])} pixels"
    preset = f", preset {scene['preset']}" if "preset" in scene else ""
    runs = {run["run"]: run for run in scene["runs"]}
    analyses = scene["analyses"]
    slopes = {name: curve["db_per_10deg"] for name, curve in analyses.get("curves", {}).items()}
    grids = [
        _grid(
            f"{scene['scene']}{preset}: {size}",
            groups,
            {name: run["splits"] for name, run in runs.items()},
            TEST_SPLITS,
            scene["noise_ceiling_db"],
            tuple(metric for metric in METRICS if metric.is_printed),
            {
                "knows": lambda name: runs[name]["knowledge"] or MISSING,
                "parameters": lambda name: _count(runs[name]["num_parameters"]),
            },
            {"drop dB ↓": {name: run["drop_db"] for name, run in runs.items()}, "dB per 10°": slopes},
        )
    ]
    for name, variant in analyses.get("variants", {}).items():
        known = [drawn for group in groups if (drawn := [run for run in group if run in variant["runs"]])]
        splits = tuple(cast(Sequence[Split], variant["noise_ceiling_db"]))
        metrics = tuple(metric for metric in METRICS if metric.in_db and metric.is_printed)
        title = f"{scene['scene']}: variant {name}"
        grids.append(_grid(title, known, variant["runs"], splits, variant["noise_ceiling_db"], metrics, {}, {}))
    return grids


def _groups(scene: Stored) -> list[list[str]]:
    """The names of runs that differ in their seed alone together; of the others alone."""
    together: list[list[str]] = [group["runs"] for group in scene["seeds"]]
    grouped = {name for group in together for name in group}
    return together + [[run["run"]] for run in scene["runs"] if run["run"] not in grouped]


def _grid(
    title: str,
    groups: list[list[str]],
    runs: Stored,
    splits: Sequence[Split],
    ceilings: Stored,
    metrics: tuple[Metric, ...],
    texts: dict[str, Callable[[str], str]],
    numbers: dict[str, Stored],
) -> Grid:
    """One table, the best run first, by its PSNR on the first split.

    Args:
        runs: splits, their metrics and means by the run's name.
        texts: further columns before the scores.
        numbers: further columns behind them, of what each run has one number.
    """

    def scores(group: list[str], metric: Metric, split: Split) -> Spread:
        return spread([_mean(runs[name].get(split), metric.key) for name in group])

    groups = sorted(groups, key=lambda group: -_comparable(scores(group, metrics[0], splits[0])))
    columns = [Column(group="run", is_number=False), *(Column(group=text, is_number=False) for text in texts)]
    columns += [
        Column(group="seeds"),
        *(Column(group=metric.title, split=split) for metric in metrics for split in splits),
    ]
    columns += [Column(group=number) for number in numbers]
    rows, best = [], set()
    first = len(texts) + 2
    for group in groups:
        row = [_group_name(group), *(text(group[0]) for text in texts.values()), str(len(group))]
        row += [_cell(scores(group, metric, split), metric.decimals) for metric in metrics for split in splits]
        row += [_cell(spread([_number(number.get(name)) for name in group]), 2) for number in numbers.values()]
        rows.append(tuple(row))
    places: list[tuple[Metric, Split]] = [(metric, split) for metric in metrics for split in splits]
    for place, (metric, split) in enumerate(places):
        values = [scores(group, metric, split).mean for group in groups]
        known = [metric.sign * value for value in values if value is not None]
        if metric.sign and len(known) > 1:
            best |= {(row, first + place) for row, value in enumerate(values) if value == metric.sign * max(known)}
    ceiling = [ceiling_text(_number(ceilings.get(split))) for split in splits]
    rest = len(columns) - first - len(ceiling)
    rows.append((CEILING, *[""] * len(texts), "", *ceiling, *[""] * rest))
    return Grid(title=title, columns=tuple(columns), rows=tuple(rows), best=frozenset(best))


def _group_name(group: list[str]) -> str:
    return re.sub(r"-seed\d+", "", group[0]) if len(group) > 1 else group[0]


def _mean(metrics: Stored | None, key: str) -> float | None:
    return None if metrics is None else _number(metrics[key]["mean"])


def _number(value: float | str | None) -> float | None:
    return math.inf if value == "inf" else cast(float | None, value)


def _comparable(value: Spread) -> float:
    return -math.inf if value.mean is None else value.mean


def _cell(value: Spread, decimals: int) -> str:
    mean = format_number(value.mean, decimals)
    return mean if value.deviation is None else f"{mean} ± {format_number(value.deviation, decimals)}"


def _count(number: int | None) -> str:
    return MISSING if number is None else f"{number:,}"
