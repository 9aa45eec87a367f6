"""The report as one HTML file that opens without a server, requests nothing, and can be read without scripts."""

import contextlib
import json
import math
import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.paths import view_name
from datagen.data.variants import OBJECT, read_edit_mask
from datagen.disk.errors import HyalineError
from datagen.disk.records import MAX_JSON_BYTES, parse_json
from datagen.disk.storage import read_regular
from datagen.look.look import or_error, stored_row
from datagen.pages.charts import line_chart
from datagen.pages.html import (
    Gallery,
    Markup,
    Part,
    anchor,
    definitions,
    document,
    join,
    panel,
    prose,
    row,
    section,
    tag,
)
from datagen.terminal.parsing import flag_words
from eval.score.runs import Run, is_number, read_costs, read_prediction
from eval.score.scores import METRIC_NOTES, RunScores, SceneScores, SplitScores
from eval.tables.grids import Grid, format_number, html_table, psnr_text
from eval.tables.plugins import PartPage
from eval.variants import VariantScores

TITLES = {"loss": ("Training loss", "loss"), "held_out_psnr": ("PSNR on held-out views", "PSNR (dB)")}
"""Titles of a curve and of its axis. Other curves use their names in the file."""
HELD_OUT_NOTE = (
    "Held-out views are training views that are not trained on. They measure progress by a quarter of their pixels, "
    "and do not compare with the scores on test views, since they are noisier."
)
MAX_VALUE = 1e30
"""Larger numbers in a run's curves count as damage."""
MOST_POINTS = 400
"""Most points of a curve on the page; from more, an even selection."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """A run's predictions of one split of its dataset or of a variant."""

    run: Run
    split: Split
    scores: SplitScores
    digests: Sequence[str]
    """SHA-256 of each picture."""

    @property
    def title(self) -> str:
        return f"{_home(self.run.dataset)}{self.split}"


def compared(scores: RunScores) -> list[Compared]:
    """The splits that a run predicted."""
    return [
        Compared(run=scores.run, split=split, scores=values, digests=scores.digests[split])
        for split, values in scores.splits.items()
        if values is not None
    ]


def ranked_views(scores: SplitScores) -> dict[int, str]:
    """The views of a split that its page shows, and what they are by PSNR: the worst, the median and the best."""
    values = [-math.inf if value is None else value for value in scores.images["psnr_db"]]
    rising = sorted(range(len(values)), key=lambda view: (values[view], view))
    named: dict[int, str] = {}
    for rank, view in (("worst", rising[0]), ("median", rising[(len(rising) - 1) // 2]), ("best", rising[-1])):
        named.setdefault(view, rank)
    return named


def store_view(gallery: Gallery, item: Compared, view: int) -> bool:
    """Adds truth and prediction of a view to the gallery; False if there is no room for both."""
    dataset, split = item.run.dataset, item.split
    is_there = gallery.add(_truth_name(dataset, split, view), lambda: dataset.view(split, view).image)
    return is_there and gallery.add(_prediction_name(item, view), lambda: read_prediction(item.run, split, view))


def view_row(
    gallery: Gallery, truths: Mapping[str, Dataset], items: Iterable[Compared], split: Split, view: int, rank: str = ""
) -> Markup:
    """A view as truth and by runs, each prediction above its error, as far as they fit.

    Args:
        truths: datasets whose pictures of the view come first, by what they are called.
        rank: of the view among the others, if it is worth saying.
    """
    name = f"{split} view {view_name(view)}{f' ({rank})' * bool(rank)}"
    panels = [
        gallery.figure(
            _truth_name(dataset, split, view),
            lambda dataset=dataset: dataset.view(split, view).image,
            label=f"{what}, {_home(dataset)}{name}",
            button=what,
        )
        for what, dataset in truths.items()
    ]
    return row(*panels, *(_prediction_panel(gallery, item, view) for item in items if item.split == split), label=name)


def _prediction_panel(gallery: Gallery, item: Compared, view: int) -> Markup | None:
    """A prediction above its error, with its score; None if it does not fit into the gallery."""
    if not store_view(gallery, item, view):
        return None
    name, pred = item.run.name, _prediction_name(item, view)
    what = f"{name}, {item.title} view {view_name(view)}"
    error = gallery.show(_truth_name(item.run.dataset, item.split, view), pred, label=f"error, {what}", class_="error")
    caption = f"{name}: {psnr_text(item.scores.images['psnr_db'][view])}"
    below = tag("p", "error × 8", class_="note")  # noqa: RUF001
    return panel(caption, gallery.show(pred, label=what), below, error, button=name)


def _home(dataset: Dataset) -> str:
    """What comes before a split's name if it is a variant's."""
    return "" if dataset.variant is None else f"{dataset.name}: "


def _truth_name(dataset: Dataset, split: Split, view: int) -> str:
    return anchor("truth", dataset.seal, split, view_name(view))


def _prediction_name(item: Compared, view: int) -> str:
    return anchor("prediction", item.digests[view])


def run_anchor(scene: SceneScores, run: Run) -> str:
    """The anchor of a run on the page."""
    return anchor("run", scene.title, run.folder.parent.name, run.name)


def run_page(scene: SceneScores, scores: RunScores, items: Sequence[Compared], gallery: Gallery) -> Markup:
    """Everything about one run.

    Args:
        items: its predictions.
    """
    run, place = scores.run, run_anchor(scene, scores.run)
    pictures: list[Part] = []
    for item in items:
        shown, truths = ranked_views(item.scores), {"truth": item.run.dataset}
        pictures += [
            tag("h2", f"{item.title}: {format_number(item.scores.mean('psnr_db'), 2)} dB"),
            tag("p", f"{len(shown)} of {len(item.digests)} views.", class_="note"),
            tag(
                "div", *(view_row(gallery, truths, [item], item.split, *view) for view in shown.items()), class_="views"
            ),
        ]
    parts: list[Part] = [
        tag("p", "On ", scene.title, class_="note"),
        *pictures,
        tag("h2", "Training"),
        training_charts(read_training(run.folder)),
        tag("h2", "Settings"),
        definitions(_facts(scores)),
        tag("h2", "Make it again"),
        _how_to_make(run),
    ]
    return tag("div", section(run.name, *parts, id_=place, level=1), class_="page", id=f"{place}-page")


def _facts(scores: RunScores) -> list[tuple[str, Part]]:
    run, record, costs = scores.run, scores.run.record, read_costs(scores.run.folder)
    known: list[tuple[str, Part]] = [
        ("method", record.method),
        ("label", record.label),
        ("knows", record.knowledge),
        ("geometry", record.geometry),
        ("layers", record.num_layers),
        ("parameters", None if record.num_parameters is None else f"{record.num_parameters:,}"),
        ("seed", record.seed),
        ("training, minutes", f"{costs['seconds'] / 60:.1f}" if "seconds" in costs else None),
        ("training, processor minutes", f"{costs['cpu_seconds'] / 60:.1f}" if "cpu_seconds" in costs else None),
        ("memory, at most", f"{costs['peak_memory_bytes'] / 1e9:.2f} GB" if "peak_memory_bytes" in costs else None),
        ("dataset", run.dataset.seal[:12]),
        ("predictions", scores.predictions_sha256[:12]),
    ]
    return [(term, value if value is not None else "unknown") for term, value in known]


def _how_to_make(run: Run) -> Markup:
    record, details = run.record, None
    if record.config:
        text = tag("pre", json.dumps(record.config, indent=2, ensure_ascii=False))
        details = tag("details", tag("summary", "All parameters"), text)
    if record.method is None or record.flags is None:
        note = "A foreign method's pictures: its folder does not record the command that made them."
        return join([tag("p", note, class_="note"), details])
    dataset = Path("data") / run.dataset.name if run.dataset.root.is_absolute() else run.dataset.root
    words = ["model", "train", record.method, str(dataset), *flag_words(record.flags.items())]
    return join([tag("pre", tag("code", shlex.join(words))), details])


def read_training(folder: Path) -> dict[str, list[tuple[float, float]]]:
    """Steps and values of a run's curves by name, from metrics.jsonl; empty without it, as for foreign methods."""
    path = folder / "metrics.jsonl"
    curves: dict[str, list[tuple[float, float]]] = {}
    with contextlib.suppress(HyalineError):  # A run that was killed may have left half a line.
        for line in read_regular(path, at_most=MAX_JSON_BYTES).splitlines() if path.is_file() else []:
            record = parse_json(line, where=str(path))
            step = record.pop("step", None)
            for key, value in record.items():
                if is_number(step) and is_number(value) and abs(value) < MAX_VALUE:
                    curves.setdefault(key, []).append((float(step), float(value)))
    return {key: points[:: -(-len(points) // MOST_POINTS)] for key, points in curves.items()}


def training_charts(curves: Mapping[str, Sequence[tuple[float, float]]]) -> Markup:
    """Curves of two points and more as charts."""
    charts: list[Part] = []
    for key, points in curves.items():
        if len(points) > 1:
            title, y_title = TITLES.get(key, (key.replace("_", " "),) * 2)
            charts.append(line_chart(points, title=f"{title} by training step", x_title="step", y_title=y_title))
    if not charts:
        return tag("p", "The run's folder contains no training curves.", class_="note")
    note = tag("p", HELD_OUT_NOTE, class_="note") if "held_out_psnr" in curves else None
    return join([tag("div", *charts, class_="charts"), note])


# The whole page


PAGE = "index.html"
EXPORTED = "scene.html"
"""A run's file that the page links: the scene live in a browser, by `model export`."""
MOST_BYTES = 20_000_000
"""Most bytes of a page's pictures."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ScenePart:
    """What a report says about one dataset."""

    scene: SceneScores
    variants: list[VariantScores]
    grids: list[Grid]
    """The table of scores, then those of variants and edits."""
    pages: list[PartPage]
    """Pages that plug-ins bring."""

    @property
    def edits(self) -> list[VariantScores]:
        return [scored for scored in self.variants if scored.variant.edit is not None]

    @property
    def anchor(self) -> str:
        return anchor("scene", self.scene.title)

    @property
    def links(self) -> dict[str, str]:
        return {scores.run.name: f"{run_anchor(self.scene, scores.run)}-page" for scores in self.scene.runs}

    def page_anchor(self, page: PartPage) -> str:
        return anchor("part", self.scene.title, page.title)

    def compared(self, scores: RunScores) -> list[Compared]:
        """The predictions of a run, of its dataset and of variants except edits."""
        name = scores.run.name
        others = [scored.runs for scored in self.variants if scored.variant.edit is None]
        found = [scores, *(runs[name] for runs in others if name in runs)]
        return [item for each in found for item in compared(each)]


def report_page(parts: Sequence[ScenePart], out: Path, *, most_bytes: int = MOST_BYTES) -> bytes:
    """The page. Pictures that do not fit are left out, with a note on the page; those of the overview come first.

    Args:
        out: the page's folder, where its links begin.
        most_bytes: bytes of all pictures.
    """
    gallery = Gallery(most_bytes)
    overview = _overview(parts, [join([_exported(part, out), _side_by_side(part, gallery)]) for part in parts])
    others = [_part_page(part, page, gallery) for part in parts for page in part.pages]
    scenes = [_scene_page(part, gallery) for part in parts]
    runs = [
        run_page(part.scene, scores, part.compared(scores), gallery) for part in parts for scores in part.scene.runs
    ]
    left_out = f"{gallery.left_out:,} pictures were left out: a page has at most {most_bytes / 1e6:g} MB of them."
    note = tag("p", left_out, class_="note") if gallery.left_out else None
    content = (gallery.store(), overview, *scenes, *others, *runs, note)
    return document("Report", *content, navigation=_navigation(parts))


def _navigation(parts: Sequence[ScenePart]) -> Markup:
    """The overview, then each scene with its runs and other pages below it."""

    def item(place: str, name: str, *below: Markup) -> Markup:
        return tag("li", tag("a", name, href=f"#{place}"), tag("ul", *below) if below else None)

    items = [item("overview-page", "Overview")]
    for part in parts:
        others = [item(f"{part.page_anchor(page)}-page", page.title) for page in part.pages]
        runs = [item(place, name) for name, place in part.links.items()]
        items.append(item(f"{part.anchor}-page", part.scene.title, *others, *runs))
    return tag("nav", tag("ul", *items), aria_label="Parts of the report")


def _overview(parts: Sequence[ScenePart], pictures: Sequence[Markup]) -> Markup:
    notes = [tag("p", prose(note), class_="note") for note in METRIC_NOTES]
    content: list[Part] = [
        tag("h1", "Report", id="overview"),
        tag("details", tag("summary", "What the numbers mean"), *notes),
    ]
    for part, side_by_side in zip(parts, pictures, strict=True):
        content += [tag("h2", part.scene.title), html_table(part.grids[0], part.links), side_by_side]
    return tag("div", *content, class_="page", id="overview-page")


def _exported(part: ScenePart, out: Path) -> Markup:
    """Links to the exported scenes of the runs."""
    pages = [(scores.run.name, scores.run.folder / EXPORTED) for scores in part.scene.runs]
    found = [(name, quote(os.path.relpath(page, out))) for name, page in pages if page.is_file()]
    return join(tag("p", "Turn the scene and move its objects: ", tag("a", name, href=to)) for name, to in found)


def _side_by_side(part: ScenePart, gallery: Gallery) -> Markup:
    """The middle view of each test split."""
    dataset, items = part.scene.dataset, [item for scores in part.scene.runs for item in compared(scores)]
    middle: dict[Split, int] = {split: dataset.config.split(split).views // 2 for split in TEST_SPLITS}
    return join(view_row(gallery, {"truth": dataset}, items, split, view) for split, view in middle.items())


def _scene_page(part: ScenePart, gallery: Gallery) -> Markup:
    dataset = part.scene.dataset
    about = f"{dataset.config.resolution} pixels, dataset {dataset.seal[:12]}"
    tables = [html_table(grid, part.links) for grid in part.grids]
    middle = dataset.view(TEST_SPLITS[0], dataset.config.split(TEST_SPLITS[0]).views // 2)
    stored = or_error(lambda: stored_row(middle, gallery))  # Normals need Mitsuba.
    edits = [_draw_edit(gallery, part.scene, edit) for edit in part.edits]
    content = section(
        part.scene.title, tag("p", about, class_="note"), stored, *tables, *edits, id_=part.anchor, level=1
    )
    return tag("div", content, class_="page", id=f"{part.anchor}-page")


def _part_page(part: ScenePart, page: PartPage, gallery: Gallery) -> Markup:
    """A page that a plug-in brings: its note, its tables, and its pictures, as far as they fit."""
    place = part.page_anchor(page)
    figures = [gallery.figure(f"{place}-{anchor(name)}", read, label=name) for name, read in page.pictures.items()]
    note = tag("p", prose(f"On {part.scene.title}. {page.note}"), class_="note")
    content = [note, *map(html_table, page.grids), row(*figures, label=page.title)]
    return tag("div", section(page.title, *content, id_=place, level=1), class_="page", id=f"{place}-page")


def _draw_edit(gallery: Gallery, scene: SceneScores, edit: VariantScores) -> Markup:
    """The view of each test split that shows most of the edited objects, as far as it fits."""
    record = edit.variant.edit
    assert record is not None
    items = [item for scores in edit.runs.values() for item in compared(scores)]
    truths = {"truth before": scene.dataset, "truth after": edit.variant}
    rows = [view_row(gallery, truths, items, split, _clearest_view(edit, split)) for split in TEST_SPLITS]
    place = anchor("edit", scene.title, edit.variant.name)
    return section(f"After {' then '.join(record.edits)}", *rows, id_=place)


def _clearest_view(edit: VariantScores, split: Split) -> int:
    views = range(edit.variant.config.split(split).views)
    return max(views, key=lambda view: np.mean(read_edit_mask(edit.variant, split, view) == OBJECT))
