"""The page of one run: its views, its training (from metrics.jsonl and costs.json), its settings, how to repeat it."""

import json
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.paths import view_name
from datagen.disk.errors import HyalineError
from datagen.disk.records import MAX_JSON_BYTES, Json, parse_json, read_regular
from datagen.pages.charts import Line, line_chart
from datagen.pages.html import Markup, Part, anchor, command, definitions, join, prose, section, tag
from datagen.pages.pictures import Gallery
from datagen.terminal.parsing import flag_words
from eval.score.runs import Run, is_number, read_costs, read_prediction
from eval.score.scores import METRICS, RunScores, SceneScores, SplitScores
from eval.tables.grids import Column, Grid, format_number, psnr_text
from eval.tables.looks import html_table


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """A run's predictions of one split of its dataset or of a variant."""

    run: Run
    split: Split
    scores: SplitScores
    digests: Sequence[str]
    """SHA-256 of each picture."""

    @property
    def dataset(self) -> Dataset:
        return self.run.dataset

    @property
    def title(self) -> str:
        return self.split if self.dataset.variant is None else f"{self.dataset.name}: {self.split}"

    def psnr_db(self, view: int) -> float | None:
        return self.scores.images["psnr_db"][view]


@dataclass(frozen=True, kw_only=True)
class ShownView:
    """A view on the page, and its rank among the others."""

    view: int
    rank: str
    """Worst, median, best, or empty."""


def ranked_views(scores: SplitScores) -> list[ShownView]:
    """All views of a split: the worst, the median and the best by PSNR, then the others from the worst on."""
    values = [-math.inf if value is None else value for value in scores.images["psnr_db"]]
    rising = sorted(range(len(values)), key=lambda view: (values[view], view))
    named: dict[int, str] = {}
    for rank, view in (("worst", rising[0]), ("best", rising[-1]), ("median", rising[(len(rising) - 1) // 2])):
        named.setdefault(view, rank)
    first = sorted(named, key=lambda view: ("worst", "median", "best").index(named[view]))
    return [ShownView(view=view, rank=named.get(view, "")) for view in (*first, *(v for v in rising if v not in named))]


def store_views(gallery: Gallery, compared: Sequence[Compared], most: int) -> dict[Compared, list[ShownView]]:
    """Adds truth and prediction of up to `most` views of each to the gallery; returns the views that fit.

    The first views of all are added before the second ones, so that a full page lacks the least important ones.
    """
    shown: dict[Compared, list[ShownView]] = {item: [] for item in compared}
    for item, candidate in _by_rank(compared, most):
        if store_view(gallery, item, candidate.view):
            shown[item].append(candidate)
    return shown


def store_view(gallery: Gallery, item: Compared, view: int) -> bool:
    """Adds truth and prediction of a view to the gallery; False if there is no room for both."""
    return store_truth(gallery, item.dataset, item.split, view) and gallery.add(
        _prediction_name(item, view), lambda: read_prediction(item.run, item.split, view)
    )


def store_truth(gallery: Gallery, dataset: Dataset, split: Split, view: int) -> bool:
    """Adds a true picture to the gallery; False if there is no room."""
    return gallery.add(truth_name(dataset, split, view), lambda: dataset.view(split, view).image)


def truth_name(dataset: Dataset, split: Split, view: int) -> str:
    """The name of a true picture in the gallery."""
    return anchor("truth", dataset.seal, split, view_name(view))


def draw_views(gallery: Gallery, item: Compared, shown: Sequence[ShownView]) -> Markup:
    """Truth, prediction and error of each of these views, which must be in the gallery."""
    return tag("div", *(_draw_view(gallery, item, view) for view in shown), class_="views")


def truth_panels(gallery: Gallery, dataset: Dataset, split: Split, view: int) -> list[Part]:
    """The truth of a view; nothing if it does not fit into the gallery."""
    if not store_truth(gallery, dataset, split, view):
        return []
    label = f"truth, {split} view {view_name(view)}"
    picture = gallery.show(truth_name(dataset, split, view), label=label)
    return [tag("figure", picture, tag("figcaption", label))]


def prediction_panel(gallery: Gallery, item: Compared, view: int) -> Markup:
    """A prediction with its score; it must be in the gallery."""
    label = f"{item.run.name}, {item.title} view {view_name(view)}"
    picture = gallery.show(_prediction_name(item, view), label=label)
    caption = tag("figcaption", item.run.name, ": ", psnr_text(item.psnr_db(view)))
    return tag("figure", picture, caption)


def _draw_view(gallery: Gallery, item: Compared, shown: ShownView) -> Markup:
    what = f"{item.title} view {view_name(shown.view)}"
    truth, pred = truth_name(item.dataset, item.split, shown.view), _prediction_name(item, shown.view)
    rank = f" ({shown.rank})" if shown.rank else ""
    return compared_figure(gallery, truth, pred, what, f"{what}{rank}: {psnr_text(item.psnr_db(shown.view))}")


def compared_figure(gallery: Gallery, truth: str, pred: str, what: str, caption: str) -> Markup:
    """Truth, prediction and their difference, under a slider where scripts run; both are in the gallery."""
    panels = [
        ("truth", gallery.show(truth, label=f"truth, {what}")),
        ("prediction", gallery.show(pred, label=f"prediction, {what}")),
        ("error × 8", gallery.show(truth, pred, label=f"error, {what}", class_="error")),  # noqa: RUF001
    ]
    drawn = tag("div", *(tag("div", picture, tag("span", name)) for name, picture in panels), class_="panels")
    return tag("figure", tag("figcaption", caption), drawn, class_="compare")


def _prediction_name(item: Compared, view: int) -> str:
    return anchor("prediction", item.digests[view])


def _by_rank(compared: Sequence[Compared], most: int) -> Iterator[tuple[Compared, ShownView]]:
    ranked = [(item, ranked_views(item.scores)) for item in compared]
    for rank in range(most):
        for item, views in ranked:
            if rank < len(views):
                yield item, views[rank]


HELD_OUT = "held_out_psnr"
TITLES = {"loss": ("Training loss", "loss"), HELD_OUT: ("PSNR on held-out views", "PSNR (dB)")}
"""Titles of a curve and of its axis. Other curves use their names in the file."""
MAX_VALUE = 1e30
"""Larger numbers in a run's curves count as damage."""
MOST_POINTS = 400
"""Most points of a curve on the page; from more, an even selection."""


Points = tuple[tuple[float, float], ...]


def run_anchor(scene: SceneScores, run: Run) -> str:
    """The anchor of a run on the page."""
    return anchor("run", scene.title, run.folder.parent.name, run.name)


def run_page(
    scene: SceneScores, scores: RunScores, views: Mapping[Compared, Sequence[ShownView]], gallery: Gallery
) -> Markup:
    """Everything about one run.

    Args:
        views: the views to show of each split that it predicted.
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
        tag("h3", "Settings"),
        definitions(_facts(scores)),
        tag("h3", "Make it again"),
        _how_to_make(run),
    ]
    return tag("div", section(run.name, *parts, id_=place), class_="page", id=f"{place}-page")


def _how_many(item: Compared, shown: int) -> Markup | None:
    count = len(item.scores.images["psnr_db"])
    if shown == count:
        return None
    more = prose(f"{shown} of {count} views; `eval report --shown-views {count}` shows as many as fit.")
    return tag("p", more, class_="note")


def _training_ceiling_db(run: Run) -> float | None:
    """None if it is unknown, or training views are missing."""
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
    return [(term, value if value is not None else "unknown") for term, value in known]


def _how_to_make(run: Run) -> Markup:
    choices = definitions(flattened(run.config or {}))
    details = [tag("details", tag("summary", "All parameters"), choices)] if run.config else []
    if run.method is None or run.flags is None:
        note = "A foreign method's pictures: its folder does not record the command that made them."
        return join([tag("p", note, class_="note"), *details])
    dataset = Path("data") / run.dataset.name if run.dataset.root.is_absolute() else run.dataset.root
    words = ["model", "train", run.method, str(dataset), *flag_words(run.flags.items())]
    return join([command(shlex.join(words)), *details])


def flattened(config: Mapping[str, Json], above: str = "") -> list[tuple[str, str]]:
    """Every setting by its path, such as `net.branches`."""
    choices: list[tuple[str, str]] = []
    for key, value in config.items():
        if isinstance(value, dict):
            choices += flattened(value, f"{above}{key}.")
        elif key != "type":
            choices.append((f"{above}{key}", value if isinstance(value, str) else json.dumps(value)))
    return choices


@dataclass(frozen=True, kw_only=True)
class Training:
    """Steps and values of each curve, by its name in the file."""

    curves: dict[str, Points]
    costs: Mapping[str, float] = field(default_factory=dict)
    """Seconds and bytes by their name in the file."""
    is_damaged: bool = False
    """True if a line could not be read; the others were."""


def read_training(folder: Path) -> Training:
    """A run's curves and costs from its files; empty without them, as for foreign methods."""
    path = folder / "metrics.jsonl"
    curves: dict[str, list[tuple[float, float]]] = {}
    costs = read_costs(folder)
    if not path.is_file():
        return Training(curves={}, costs=costs)
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
                if is_number(value) and abs(value) < MAX_VALUE:
                    curves.setdefault(key, []).append((float(step), float(value)))
    return Training(
        curves={key: _thinned(points) for key, points in curves.items()},
        costs=costs,
        is_damaged=is_damaged,
    )


def describe_costs(training: Training) -> list[tuple[str, str]]:
    """The costs of training in words."""
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
    """The costs, curves as charts, and the values of curves with a single point.

    Args:
        held_out_ceiling_db: PSNR at which the noise of the training views stops a perfect method, where that is known.
    """
    # A single evaluation is a number, not a curve.
    single = [(_titles(key)[0], points[0]) for key, points in training.curves.items() if len(points) == 1]
    facts = [*describe_costs(training), *((title, f"{y:.4g} at step {x:,.0f}") for title, (x, y) in single)]
    charts = [_chart(key, points, held_out_ceiling_db) for key, points in training.curves.items() if len(points) > 1]
    damaged = tag("p", "A part of metrics.jsonl cannot be read.", class_="bad") if training.is_damaged else None
    drawn = tag("div", *charts, class_="charts") if charts else None
    if not training.curves:
        drawn = tag("p", "The run's folder contains no training curves.", class_="note")
    return join([definitions(facts) if facts else None, damaged, drawn])


def _titles(key: str) -> tuple[str, str]:
    """Titles of a curve and of its axis."""
    return TITLES.get(key, (key.replace("_", " "), key.replace("_", " ")))


def _chart(key: str, points: Points, ceiling_db: float | None) -> Markup:
    title, y_title = _titles(key)
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
            "Held-out views are training views that are not trained on. They measure progress by a quarter of their "
            f"pixels, and do not compare with the scores on test views, since they are noisier {why}.",
            class_="note",
        )
    chart = line_chart(tuple(lines), title=f"{title} by training step", x_title="step", y_title=y_title)
    return tag("div", chart, note)


def _thinned(points: list[tuple[float, float]]) -> Points:
    every = -(-len(points) // MOST_POINTS)
    return tuple(points[::every])
