"""The scores as data: results.json with every picture's value, CSV with one line per run, and RESULTS.md made from
stored results.json files."""

import csv
import dataclasses
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from datagen.data.config import TEST_SPLITS, Resolution, Split
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, load_json, shown
from datagen.disk.storage import dump_json
from eval.score.scores import METRICS, Metric, RunScores, SceneScores, metric_notes
from eval.score.seeds import SeedGroup, Spread, describe_run, group_seeds, spread
from eval.tables.grids import CEILING, MISSING, TABLE_WIDTH, Column, Grid, ceiling_text, format_number, left_out_notes
from eval.tables.looks import grid_text, markdown_escaped

RESULTS_VERSION = 1

Cell = str | int | None


def results_json(
    scenes: list[SceneScores],
    analyses: Mapping[str, dict[str, Json]] | None = None,
    more: Mapping[str, Json] | None = None,
) -> bytes:
    """The bytes of results.json. Infinite values are the string "inf", because JSON has no such number.

    Args:
        analyses: results of the analyses, by the scene's title.
        more: further top-level entries.
    """
    return dump_json(
        {
            "version": RESULTS_VERSION,
            "notes": list(metric_notes(is_wrapped=True)),
            "scenes": [_scene_json(scene, (analyses or {}).get(scene.title, {})) for scene in scenes],
            **(more or {}),
        }
    )


def results_csv(scenes: list[SceneScores]) -> str:
    """One line per run, two per group of seeds, one per scene for the noise ceiling; empty if not computed."""
    scored = [f"{metric.key}_{split}" for metric in METRICS for split in TEST_SPLITS]
    known = ["method", "label", "geometry", "knowledge", "num_parameters", "seed"]
    buffer = io.StringIO()
    table = csv.DictWriter(
        buffer,
        ["scene", "run", *known, *scored, "drop_db", "dataset_seal", "predictions_sha256", "config_sha256"],
        lineterminator="\n",
    )
    table.writeheader()
    for scene in scenes:
        place = {"scene": csv_text(scene.title), "dataset_seal": scene.dataset.seal}
        for scores in scene.runs:
            means = {f"{m.key}_{split}": scores.mean(m.key, split) for m in METRICS for split in TEST_SPLITS}
            about = {key: csv_text(getattr(scores.run, key)) for key in known}
            last = {
                "drop_db": scores.drop_db,
                "predictions_sha256": scores.predictions_sha256,
                "config_sha256": describe_run(scores.run),
            }
            table.writerow({**place, "run": csv_text(scores.run.name), **about, **means, **last})
        for group in group_seeds(scene.runs):
            if len(group.runs) > 1:
                keys = ("method", "geometry", "knowledge", "num_parameters")
                same = {key: csv_text(getattr(group.first, key)) for key in keys}
                spreads = _group_spreads(group)
                same["config_sha256"] = describe_run(group.first)
                count = len(group.runs)
                for what in ("mean", "deviation"):
                    numbers = {key: getattr(value, what) for key, value in spreads.items()}
                    table.writerow(
                        {**place, "run": csv_text(f"{group.name} ({what} of {count} seeds)"), **same, **numbers}
                    )
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
        "noise_ceiling_db": {split: scene.ceilings_db[split] for split in TEST_SPLITS},
        "notes": list(left_out_notes(scene)),
        "runs": [_run_json(scores) for scores in scene.runs],
        "seeds": [_group_json(group) for group in group_seeds(scene.runs) if len(group.runs) > 1],
        "analyses": _finite(analyses),
    }


def _group_json(group: SeedGroup) -> Json:
    return {
        "runs": [scores.run.name for scores in group.runs],
        "config_sha256": describe_run(group.first),
        "scores": {
            key: {"mean": json_number(value.mean), "deviation": value.deviation}
            for key, value in _group_spreads(group).items()
        },
    }


def _group_spreads(group: SeedGroup) -> dict[str, Spread]:
    """Spreads by the names of the CSV's columns."""
    scores = {f"{m.key}_{split}": group.score(m.key, split) for m in METRICS for split in TEST_SPLITS}
    return {**scores, "drop_db": group.drop_db}


def _run_json(scores: RunScores) -> Json:
    run = scores.run
    splits: dict[str, Json] = {}
    for split, values in scores.splits.items():
        if values is None:
            splits[split] = None
            continue
        splits[split] = {
            metric.key: {
                "mean": json_number(values.mean(metric.key)),
                "pictures": [json_number(value) for value in values.images[metric.key]],
            }
            for metric in METRICS
        }
    return {
        "run": run.name,
        "method": run.method,
        "label": run.label,
        "geometry": run.geometry,
        "knowledge": run.knowledge,
        "num_parameters": run.num_parameters,
        "seed": run.seed,
        "config_sha256": describe_run(run),
        "predictions_sha256": scores.predictions_sha256,
        "drop_db": cast(Json, scores.drop_db),
        "splits": splits,
    }


def _finite(data: Json) -> Json:
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_finite(value) for value in data]
    return json_number(data) if isinstance(data, float) else data


def json_number(value: float | None) -> Json:
    return "inf" if value is not None and math.isinf(value) else value


HEAD = """# Results

Every table comes from a `results.json` that `eval report` wrote, stored in [docs/results](docs/results). To add one, \
copy it there and run `make results`, which writes this page. Measurements of earlier versions, and what was \
tried, are in the notes: [history](docs/notes/history.md), [speed](docs/notes/speed.md).
"""

NOTES = (
    "dB per 10°: how PSNR falls with the angle between a test ray and the nearest training ray that met its texel. ±: "
    "sample standard deviation over seeds.",
)

Stored = dict[str, Any]
"""A part of results.json."""


def results_page(paths: Sequence[Path]) -> str:
    """The page: a section per file, sorted by name."""
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
        raise HyalineError(f"{path}: lacks {error}; expected a results.json of `eval report`") from error
    about = f"[{path.name}]({path.as_posix()}); hyaline {code}."
    return "\n".join([f"\n## {path.stem}\n", f"```\n{command}\n```\n", f"{about}\n", *tables])


def _grids(scene: Stored) -> list[Grid]:
    """The scores of a scene, then of each variant that its runs predicted."""
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
    if fits := analyses.get("fits"):
        grids.append(_fits_grid(f"{scene['scene']}: glass found from masks and pictures", fits))
    return grids


def _fits_grid(title: str, fits: Stored) -> Grid:
    """What `model fit` found of each object, beside the truth in brackets."""
    texts = ("fit", "object", "kind")
    columns = ("surface mm ↓", "normals ° ↓", "wall mm", "index", "absorption 1/m", "roughness")
    return Grid(
        title=title,
        columns=(*(Column(group=text, is_number=False) for text in texts), *(Column(group=text) for text in columns)),
        rows=tuple(
            (fit, name, item["kind"], *_fit_cells(item["numbers"], item["measured"]))
            for fit, objects in fits.items()
            for name, item in objects.items()
        ),
        notes=(
            "True values in brackets. Surface: mean distance of the whole surface, insides too, from the true one. "
            "Normals: median error. Wall: median thickness.",
        ),
    )


def _fit_cells(numbers: Stored, measured: Stored) -> tuple[str, ...]:
    """Surface, normals, wall, index, absorption and roughness of one object."""
    errors, true = measured["errors"] or {}, measured["true"]

    def found(key: str, decimals: int) -> str:
        if numbers.get(key) is None:
            return MISSING
        value = format_number(numbers[key]["value"], decimals)
        return value if true.get(key) is None else f"{value} ({format_number(true[key], decimals)})"

    def millimetres(key: str) -> str:
        return format_number(None if errors.get(key) is None else 1000 * errors[key], 2)

    has_wall = numbers.get("wall") is not None
    tints = [found(f"absorption_{channel}", 1) for channel in ("red", "green", "blue")]
    return (
        millimetres("mean_distance"),
        format_number(_number(errors.get("normal_deg")), 1),
        f"{millimetres('thickness')} ({millimetres('true_thickness')})" if has_wall else MISSING,
        found("ior", 3),
        MISSING if MISSING in tints else ", ".join(tints),
        found("roughness", 2),
    )


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
    metrics: tuple[Metric, ...],
    texts: dict[str, Callable[[str], str]],
    numbers: dict[str, Stored],
) -> Grid:
    """One table, the best run first, by its PSNR on the first split.

    Args:
        runs: splits with their metrics and means, by the run's name.
        texts: further columns before the scores.
        numbers: further columns after them, with one number per run.
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
