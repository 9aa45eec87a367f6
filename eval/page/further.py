"""The report's parts beyond scores: the analyses of a scene with their tables and data, and all pictures.

matplotlib is imported only when a picture is drawn.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from datagen.data.config import Split
from datagen.data.variants import ANGLES, is_larger
from datagen.disk.errors import HyalineError
from datagen.disk.names import file_name
from datagen.disk.records import Json, to_json
from datagen.terminal.command import say, track
from eval.analyses.coverage import cover_view, read_coverage
from eval.analyses.curve import Curve, curve_grid, make_curve, pool_seeds
from eval.analyses.edits import EditScores, edit_grids, edit_json, edit_sheet, score_edits
from eval.analyses.variants import (
    VariantScores,
    angle_grid,
    score_enlarged,
    score_variants,
    super_resolution_grid,
    super_resolution_json,
    variant_json,
)
from eval.page.report_folder import Draw
from eval.score.runs import Run
from eval.score.scores import SceneScores
from eval.tables.grids import Grid
from eval.tables.parts import FoundPart, PartPage


@dataclass(frozen=True, kw_only=True, eq=False)
class Further:
    """The analyses of a scene; each is there only if the dataset and the runs have what it needs."""

    title: str
    """The scene's title."""
    grids: tuple[Grid, ...]
    data: dict[str, Json]
    """For results.json."""
    figures: dict[str, Draw]
    """By the name of their file."""
    curves: dict[str, Curve]
    """By the run's name, over seeds where there are several."""
    variants: tuple[VariantScores, ...]
    edits: tuple[EditScores, ...]
    pages: tuple[PartPage, ...]
    """Pages that plug-ins bring."""


def analyse(scene: SceneScores, errors: list[HyalineError], parts: Mapping[str, FoundPart]) -> Further:
    """All analyses of a scored scene.

    Args:
        errors: problems of runs are added here; the other runs are analysed.
        parts: what plug-ins know of it, by their names.
    """
    grids: list[Grid] = []
    data: dict[str, Json] = {}
    figures: dict[str, Draw] = {}
    name = file_name(scene.title)

    variants = score_variants(scene, errors)
    by_name: dict[str, Json] = {}
    by_angle = next((scored for scored in variants if scored.variant.name == ANGLES), None)
    if by_angle is not None:
        grids.append(angle_grid(scene, by_angle))
        by_name[ANGLES] = variant_json(by_angle)
    pooled: dict[str, Curve] = {}
    if curves := _curves(scene, by_angle):
        pooled = pool_seeds(scene.runs, curves)
        grids.append(curve_grid(scene.title, pooled))
        data["curves"] = to_json(curves)
        figures[f"curve_{name}.svg"] = partial(_curve_figure, scene.title, pooled)
    if larger := [(scored, score_enlarged(scene, scored)) for scored in variants if is_larger(scored.variant)]:
        grids.append(super_resolution_grid(scene, larger))
        by_name |= {scored.variant.name: super_resolution_json(scored, enlarged) for scored, enlarged in larger}
    if edits := score_edits(scene, variants, errors):
        grids += edit_grids(scene.title, edits, scene.runs)
        by_name |= {edit.edited.name: edit_json(edit) for edit in edits}
        figures |= {
            f"edit_{name}_{file_name(edit.edited.name)}.png": partial(edit_sheet, scene, edit) for edit in edits
        }
    if by_name:
        data["variants"] = by_name
    data |= {part_name: part.data for part_name, part in parts.items()}
    return Further(
        title=scene.title,
        grids=tuple(grids),
        data=data,
        figures=figures,
        curves=pooled,
        variants=tuple(variants),
        edits=edits,
        pages=tuple(page for part in parts.values() for page in part.pages),
    )


def _curves(scene: SceneScores, by_angle: VariantScores | None) -> dict[str, Curve]:
    """The extrapolation curves by the run's name; none without straight layers."""
    if not scene.has_glass_mask:
        return {}
    truths, scored = scene.truths, [*scene.runs]
    if by_angle is not None:
        truths, scored = truths | by_angle.truths, [*scored, *by_angle.runs.values()]
    runs: dict[str, dict[Split, Run]] = {}
    for scores in scored:
        predicted: dict[Split, Run] = {split: scores.run for split, found in scores.splits.items() if found is not None}
        if predicted:
            runs[scores.run.name] = runs.get(scores.run.name, {}) | predicted
    say(f"{scene.title}: reading the coverage of the training views")
    training, covered = read_coverage(scene.dataset), {}
    wanted: set[Split] = {split for predicted in runs.values() for split in predicted}
    for split in wanted:
        home = truths[split].dataset
        views = range(home.config.split(split).views)
        covered[split] = tuple(cover_view(training, home, split, view) for view in views)
    return {
        name: make_curve(predicted, truths, {split: covered[split] for split in predicted})
        for name, predicted in track(runs.items(), label=f"curves of {scene.title}", total=len(runs))
    }


def figures_of(scenes: list[SceneScores], further: list[Further]) -> dict[str, Draw]:
    """By file name: a sheet per run, a comparison and the cameras per scene, then the analyses' figures."""
    from eval.figures import cameras_figure, comparison_sheet, contact_sheet

    figures: dict[str, Draw] = {}
    for scene in scenes:
        name = file_name(scene.title)
        for scores in scene.runs:
            figures[f"{name}_{file_name(scores.run.name)}.png"] = partial(contact_sheet, scene, scores)
        if len(scene.runs) > 1:
            figures[f"comparison_{name}.png"] = partial(comparison_sheet, scene, "all runs")
        figures[f"cameras_{name}.png"] = partial(cameras_figure, scene.dataset, scene.title)
    for analyses in further:
        figures |= analyses.figures
    return figures


def _curve_figure(title: str, curves: dict[str, Curve]) -> bytes:
    from eval.analyses.plots import curve_figure

    return curve_figure(title, curves)
