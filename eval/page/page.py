"""The report as one HTML file that opens without a server, requests nothing, and can be read without scripts."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.variants import OBJECT, read_edit_mask
from datagen.pages.html import Markup, Part, anchor, document, join, prose, section, tag
from datagen.pages.pictures import Gallery
from eval.page.run_page import (
    Compared,
    compared,
    prediction_panel,
    run_anchor,
    run_page,
    store_views,
    truth_panel,
)
from eval.score.scores import METRIC_NOTES, SceneScores
from eval.tables.grids import Grid, html_table
from eval.tables.plugins import PartPage
from eval.variants import VariantScores

PAGE = "index.html"
MOST_BYTES = 20_000_000
"""Most bytes of a page's pictures."""
USUAL_VIEWS = 3
"""Views shown by default for each split and run: the worst, the median and the best."""


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

    def compared(self) -> dict[str, list[Compared]]:
        """The predictions of each run, by its name, of its dataset and of variants except edits."""
        others = [scored.runs for scored in self.variants if scored.variant.edit is None]
        return {
            scores.run.name: [
                item
                for each in (scores, *(runs[scores.run.name] for runs in others if scores.run.name in runs))
                for item in compared(each)
            ]
            for scores in self.scene.runs
        }


def report_page(parts: Sequence[ScenePart], *, most_views: int = USUAL_VIEWS, most_bytes: int = MOST_BYTES) -> bytes:
    """The page. Pictures that do not fit are left out, with a note on the page; the most important ones come first.

    Args:
        most_views: views shown of each split and run.
        most_bytes: bytes of all pictures.
    """
    gallery = Gallery(most_bytes)
    listed = [(part, part.compared()) for part in parts]
    overview = _overview(parts, [_side_by_side(part, gallery) for part in parts])
    others = [_part_page(part, page, gallery) for part in parts for page in part.pages]
    every = [item for _, of_part in listed for items in of_part.values() for item in items]
    store_views(gallery, every, min(most_views, USUAL_VIEWS))
    scenes = [_scene_page(part, gallery) for part in parts]
    shown = store_views(gallery, every, most_views)
    runs = [
        run_page(part.scene, scores, {item: shown[item] for item in of_part[scores.run.name]}, gallery)
        for part, of_part in listed
        for scores in part.scene.runs
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
    content: list[Part] = [tag("h1", "Report", id="overview")]
    for part, side_by_side in zip(parts, pictures, strict=True):
        content += [tag("h2", part.scene.title), html_table(part.grids[0], part.links), side_by_side]
    content += [tag("p", prose(note), class_="note") for note in METRIC_NOTES]
    return tag("div", *content, class_="page", id="overview-page")


def _row(gallery: Gallery, truths: Sequence[Part], items: Iterable[Compared], split: Split, view: int) -> Markup:
    """A view as truth and by all runs, as far as they fit."""
    return tag(
        "div",
        *truths,
        *(prediction_panel(gallery, item, view) for item in items if item.split == split),
        class_="sheet wide",
    )


def _side_by_side(part: ScenePart, gallery: Gallery) -> Markup:
    """The middle view of each test split."""
    rows, items = [], [item for scores in part.scene.runs for item in compared(scores)]
    for split in TEST_SPLITS:
        view = part.scene.dataset.config.split(split).views // 2
        rows.append(_row(gallery, [truth_panel(gallery, part.scene.dataset, split, view)], items, split, view))
    return join(rows)


def _scene_page(part: ScenePart, gallery: Gallery) -> Markup:
    dataset = part.scene.dataset
    about = f"{dataset.config.resolution} pixels, dataset {dataset.seal[:12]}"
    tables = [html_table(grid, part.links) for grid in part.grids]
    edits = [_draw_edit(gallery, part.scene, edit) for edit in part.edits]
    content = section(part.scene.title, tag("p", about, class_="note"), *tables, *edits, id_=part.anchor)
    return tag("div", content, class_="page", id=f"{part.anchor}-page")


def _part_page(part: ScenePart, page: PartPage, gallery: Gallery) -> Markup:
    """A page that a plug-in brings: its note, its tables, and its pictures, as far as they fit."""
    place = part.page_anchor(page)
    figures = [
        gallery.figure(f"{place}-{anchor(name)}", read, label=name, caption=name)
        for name, read in page.pictures.items()
    ]
    note = tag("p", prose(f"On {part.scene.title}. {page.note}"), class_="note")
    content = [note, *map(html_table, page.grids), tag("div", *figures, class_="charts")]
    return tag("div", section(page.title, *content, id_=place), class_="page", id=f"{place}-page")


def _draw_edit(gallery: Gallery, scene: SceneScores, edit: VariantScores) -> Markup:
    """The view of each test split that shows most of the edited objects, as far as it fits."""
    record = edit.variant.edit
    assert record is not None
    rows, items = [], [item for scores in edit.runs.values() for item in compared(scores)]
    for split in TEST_SPLITS:
        view = _clearest_view(edit, split)
        truths = [
            truth_panel(gallery, scene.dataset, split, view, "truth before"),
            truth_panel(gallery, edit.variant, split, view, "truth after"),
        ]
        rows.append(_row(gallery, truths, items, split, view))
    place = anchor("edit", scene.title, edit.variant.name)
    return section(f"After {' then '.join(record.edits)}", *rows, id_=place, level=3)


def _clearest_view(edit: VariantScores, split: Split) -> int:
    views = range(edit.variant.config.split(split).views)
    return max(views, key=lambda view: np.mean(read_edit_mask(edit.variant, split, view) == OBJECT))
