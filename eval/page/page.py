"""The report as one HTML file that opens without a server, requests nothing, and can be read without scripts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.paths import view_name
from datagen.data.variants import OBJECT, read_edit_mask
from datagen.pages.html import Markup, Part, anchor, document, join, prose, section, tag
from datagen.pages.pictures import Encoded, Gallery
from eval.analyses.edits import EditScores
from eval.page.further import Further
from eval.page.run_page import (
    Compared,
    ShownView,
    prediction_panel,
    run_anchor,
    run_page,
    store_truth,
    store_view,
    store_views,
    truth_name,
    truth_panels,
)
from eval.score.scores import RunScores, SceneScores, metric_notes
from eval.score.seeds import group_seeds
from eval.tables.grids import Column, Grid, format_number
from eval.tables.looks import html_table
from eval.tables.parts import PartPage
from eval.tables.scenes import Stored, scene_grids

PAGE = "index.html"
MOST_BYTES = 20_000_000
"""Largest page in bytes. Tables and curves come first, and pictures get the remaining room."""
USUAL_VIEWS = 3
"""Views shown by default for each split and run: the worst, the median and the best."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _ScenePart:
    """The parts of a page for one scene."""

    scene: SceneScores
    further: Further
    stored: Stored
    """In results.json."""
    views: dict[str, dict[Compared, list[ShownView]]]
    """By `run_anchor`."""
    side_by_side: Markup
    edits: list[Markup]


def report_page(
    scenes: Sequence[SceneScores],
    further: Sequence[Further],
    stored: Sequence[Stored],
    *,
    most_views: int = USUAL_VIEWS,
    most_bytes: int = MOST_BYTES,
) -> bytes:
    """The page, at most `most_bytes` long unless tables and curves alone are longer.

    Args:
        further: the analyses of each scene.
        stored: the scenes of results.json.
        most_views: views shown of each split and run.
        most_bytes: pictures that do not fit into this size are left out, with a note on the page.
    """
    encoded: Encoded = {}
    room = most_bytes
    while True:
        gallery = Gallery(room, encoded)
        page = _draw_page(scenes, further, stored, gallery, most_views=most_views)
        if len(page) <= most_bytes or not gallery.used:
            return page
        room = max(0, gallery.used - (len(page) - most_bytes))  # The rest of the page has to fit as well.


def _draw_page(
    scenes: Sequence[SceneScores],
    further: Sequence[Further],
    stored: Sequence[Stored],
    gallery: Gallery,
    *,
    most_views: int,
) -> bytes:
    """The page with the pictures that fit into a gallery, the most important ones first."""
    pairs = list(zip(scenes, further, strict=True))
    compared = {
        scene.title: {run_anchor(scene, scores.run): _compared(scores, more) for scores in scene.runs}
        for scene, more in pairs
    }
    every = [item for of_scene in compared.values() for items in of_scene.values() for item in items]
    overviews = {scene.title: _side_by_side(scene, compared[scene.title], gallery) for scene in scenes}
    others = [_part_page(scene, page, gallery) for scene, more in pairs for page in more.pages]
    store_views(gallery, every, min(most_views, USUAL_VIEWS))
    edits = {scene.title: [draw_edit(gallery, scene, edit) for edit in more.edits] for scene, more in pairs}
    shown = store_views(gallery, every, most_views)
    parts = [
        _ScenePart(
            scene=scene,
            further=more,
            stored=of_scene,
            views={run: {item: shown[item] for item in items} for run, items in compared[scene.title].items()},
            side_by_side=overviews[scene.title],
            edits=edits[scene.title],
        )
        for scene, more, of_scene in zip(scenes, further, stored, strict=True)
    ]
    overview = _overview(parts)
    analyses = [_scene_page(part) for part in parts]
    runs = [
        run_page(part.scene, s, part.views[run_anchor(part.scene, s.run)], gallery)
        for part in parts
        for s in part.scene.runs
    ]
    left_out = (
        tag("p", f"{gallery.left_out:,} pictures were left out: a page has at most 20 MB.", class_="note")
        if gallery.left_out
        else None
    )
    return document(
        "Report",
        gallery.store(),
        overview,
        *analyses,
        *others,
        *runs,
        left_out,
        navigation=_navigation(parts),
    )


def scenes_grid(scenes: Sequence[SceneScores]) -> Grid:
    """PSNR of each run on every scene, runs of one name together; the mean over seeds where there are several."""
    columns = [Column(group="run", is_number=False)]
    columns += [Column(group=scene.title, split=split) for scene in scenes for split in TEST_SPLITS]
    groups = {scene.title: {group.name: group for group in group_seeds(scene.runs)} for scene in scenes}
    names = sorted({name for found in groups.values() for name in found})
    values = [
        [
            groups[scene.title][name].score("psnr_db", split).mean if name in groups[scene.title] else None
            for scene in scenes
            for split in TEST_SPLITS
        ]
        for name in names
    ]
    best = set()
    for place in range(len(columns) - 1):
        known = [(value, row) for row, line in enumerate(values) if (value := line[place]) is not None]
        if len(known) > 1:
            best.add((max(known)[1], place + 1))
    rows = [(name, *(format_number(value, 2) for value in line)) for name, line in zip(names, values, strict=True)]
    return Grid(title="PSNR dB over scenes", columns=tuple(columns), rows=tuple(rows), best=frozenset(best))


def _compared(scores: RunScores, further: Further) -> list[Compared]:
    """A run's predictions of its dataset and of variants except edits."""
    listed = [scores]
    for scored in further.variants:
        if scored.variant.edit is None and scores.run.name in scored.runs:
            listed.append(scored.runs[scores.run.name])
    return [
        Compared(run=item.run, split=split, scores=values, digests=item.digests[split])
        for item in listed
        for split, values in item.splits.items()
        if values is not None
    ]


def _navigation(parts: Sequence[_ScenePart]) -> Markup:
    """The overview, then each scene with its runs and other pages below it."""

    def item(place: str, name: str, *below: Markup) -> Markup:
        return tag("li", tag("a", name, href=f"#{place}-page"), tag("ul", *below) if below else None)

    items = [item("overview", "Overview")]
    for part in parts:
        runs = [item(run_anchor(part.scene, scores.run), scores.run.name) for scores in part.scene.runs]
        others = [item(_part_anchor(part.scene, page), page.title) for page in part.further.pages]
        items.append(item(_scene_anchor(part.scene), part.scene.title, *others, *runs))
    return tag("nav", tag("ul", *items), aria_label="Parts of the report")


def _scene_anchor(scene: SceneScores) -> str:
    return anchor("scene", scene.title)


def _links(scene: SceneScores) -> dict[str, str]:
    return {scores.run.name: f"{run_anchor(scene, scores.run)}-page" for scores in scene.runs}


def _overview(parts: Sequence[_ScenePart]) -> Markup:
    scenes = [part.scene for part in parts]
    content: list[Part] = [tag("h1", "Report", id="overview")]
    if len(scenes) > 1:
        content.append(html_table(scenes_grid(scenes)))
    for part in parts:
        scores, _ = scene_grids(part.stored)
        content += [tag("h2", part.scene.title), html_table(scores, _links(part.scene)), part.side_by_side]
    content += [tag("p", prose(note), class_="note") for note in metric_notes(is_wrapped=False)]
    return tag("div", *content, class_="page", id="overview-page")


def _side_by_side(scene: SceneScores, compared: dict[str, list[Compared]], gallery: Gallery) -> Markup:
    """The middle view of each test split, as truth and by all runs, as far as they fit."""
    rows = []
    for split in TEST_SPLITS:
        view = scene.dataset.config.split(split).views // 2
        panels = truth_panels(gallery, scene.dataset, split, view)
        for item in (item for items in compared.values() for item in items):
            if item.split == split and item.dataset.variant is None and store_view(gallery, item, view):
                panels.append(prediction_panel(gallery, item, view))
        rows.append(tag("div", *panels, class_="sheet wide"))
    return join(rows)


def _scene_page(part: _ScenePart) -> Markup:
    scene, place, links = part.scene, _scene_anchor(part.scene), _links(part.scene)
    _, described = scene_grids(part.stored)
    config = scene.dataset.config
    about = f"{config.resolution} pixels, dataset {scene.dataset.seal[:12]}"
    content: list[Part] = [tag("p", about, class_="note")]
    if part.further.curves:
        from eval.analyses.plots import curve_charts

        content += [
            tag("h3", "Error against what training saw"),
            tag("div", *curve_charts(part.further.curves), class_="charts"),
        ]
    content += [html_table(grid, links) for grid in (described, *part.further.grids)]
    content += part.edits
    return tag("div", section(scene.title, *content, id_=place), class_="page", id=f"{place}-page")


def _part_anchor(scene: SceneScores, page: PartPage) -> str:
    return anchor("part", scene.title, page.title)


def _part_page(scene: SceneScores, page: PartPage, gallery: Gallery) -> Markup:
    """A page that a plug-in brings: its note, its tables, and its pictures, as far as they fit."""
    place, figures = _part_anchor(scene, page), []
    for name, read in page.pictures.items():
        if gallery.add(key := f"{place}-{anchor(name)}", read):
            figures.append(tag("figure", gallery.show(key, label=name), tag("figcaption", name)))
    note = tag("p", prose(f"On {scene.title}. {page.note}"), class_="note")
    parts = [note, *map(html_table, page.grids), tag("div", *figures, class_="charts")]
    return tag("div", section(page.title, *parts, id_=place), class_="page", id=f"{place}-page")


def draw_edit(gallery: Gallery, scene: SceneScores, edit: EditScores) -> Markup:
    """The view of each test split that shows most of the edited objects, as far as it fits."""
    record = edit.edited.edit
    assert record is not None
    rows: list[Part] = []
    for split in TEST_SPLITS:
        view = _clearest_view(edit, split)
        panels: list[Part] = [
            _truth(gallery, dataset, split, view, when)
            for dataset, when in ((scene.dataset, "before"), (edit.edited, "after"))
        ]
        for scores in edit.scored.runs.values():
            if (values := scores.splits[split]) is not None:
                item = Compared(run=scores.run, split=split, scores=values, digests=scores.digests[split])
                panels.append(prediction_panel(gallery, item, view) if store_view(gallery, item, view) else None)
        rows.append(tag("div", *panels, class_="sheet wide"))
    place = anchor("edit", scene.title, edit.edited.name)
    return section(f"After {' then '.join(record.edits)}", *rows, id_=place, level=3)


def _clearest_view(edit: EditScores, split: Split) -> int:
    views = range(edit.edited.config.split(split).views)
    return max(views, key=lambda view: np.mean(read_edit_mask(edit.edited, split, view) == OBJECT))


def _truth(gallery: Gallery, dataset: Dataset, split: Split, view: int, when: str) -> Markup | None:
    if not store_truth(gallery, dataset, split, view):
        return None
    caption = f"truth {when}, {split} view {view_name(view)}"
    picture = gallery.show(truth_name(dataset, split, view), label=caption)
    return tag("figure", picture, tag("figcaption", caption))
