"""An edit in a report's page: the truth before and after it, and what each run drew."""

import numpy as np

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.edit_masks import OBJECT, read_edit_mask
from datagen.data.paths import view_name
from datagen.pages.document import anchor, section
from datagen.pages.html import Markup, Part, tag
from datagen.pages.pictures import Gallery
from eval.analyses.edits import EditScores
from eval.page.views import Compared, prediction_panel, store_truth, store_view, truth_name
from eval.score.scores import SceneScores


def draw_edit(gallery: Gallery, scene: SceneScores, edit: EditScores) -> Markup:
    """The view of each test split that shows most of the edited objects, as far as the gallery has room."""
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
