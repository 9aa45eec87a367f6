"""The picture sheet of an edit."""

import numpy as np

from datagen.data.config import TEST_SPLITS
from datagen.data.edit_masks import OBJECT, read_edit_mask
from datagen.data.paths import view_name
from eval.analyses.edits import EditScores
from eval.figures.sheets import Panel, Row, draw_sheet
from eval.score.metrics import psnr
from eval.score.runs import has_split, read_prediction
from eval.score.scores import SceneScores
from eval.score.seeds import by_group
from eval.tables.grids import psnr_text

EDIT_VIEWS = 2
"""Views of each split on the sheet of an edit."""


def edit_sheet(scene: SceneScores, edit: EditScores) -> bytes:
    """The PNG of an edit: the truth before and after it, and what each run drew (of runs that differ in their seed
    alone, the first one), in the views that show most of it."""
    drawn = by_group(scene.runs, {run.name: run for run in edit.runs})
    runs = [members[0] for members in drawn.values()]
    rows = []
    for split in TEST_SPLITS:
        views = range(edit.edited.config.split(split).views)
        shares = [float(np.mean(read_edit_mask(edit.edited, split, view) == OBJECT)) for view in views]
        for view in sorted(sorted(views, key=lambda view: -shares[view])[:EDIT_VIEWS]):
            truths = [dataset.view(split, view).image for dataset in (scene.dataset, edit.edited)]
            panels = [Panel(image=image, caption=f"view {view_name(view)}") for image in truths]
            for run in runs:
                pred = read_prediction(run, split, view) if has_split(run, split) else None
                panels.append(Panel(image=pred, caption="" if pred is None else psnr_text(psnr(pred, truths[1]))))
            rows.append(Row(split=split, panels=tuple(panels)))
    heads = ("truth before", "truth after", *(run.name for run in runs))
    title = f"{scene.title}: {edit.edited.name}"
    return draw_sheet(title, heads, rows, size=scene.dataset.config.resolution)
