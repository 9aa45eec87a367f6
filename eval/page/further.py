"""Owns what a report shows of a scene beyond the scores: which analyses there are, their tables, data and figures."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from datagen.data.config import Split
from datagen.data.variants import homes_of_test_splits
from datagen.disk.errors import HyalineError
from datagen.disk.names import file_name
from datagen.disk.records import Json, to_json
from datagen.terminal.command import say, track
from eval.analyses.angle_scores import angle_grid, angles_json, read_angle_truths, score_angles
from eval.analyses.budget import budget_grid, find_budgets
from eval.analyses.coverage import PixelCoverage, cover_view, read_coverage
from eval.analyses.curve import Curve, curve_grid, make_curve, pool_seeds
from eval.analyses.edit_sheet import edit_sheet
from eval.analyses.edit_tables import edit_grids, edit_json, order_grid, order_json
from eval.analyses.edits import score_edits
from eval.analyses.order import score_order
from eval.analyses.plots import budget_figure, curve_figure
from eval.analyses.super_resolution import score_scaled, super_resolution_grid, super_resolution_json
from eval.score.scores import RunScores, SceneScores, Truth
from eval.tables.grids import Grid


@dataclass(frozen=True, kw_only=True, eq=False)
class Further:
    """What was found out of a scene; each part is there only when the dataset and the runs have what it needs."""

    title: str
    """The scene's."""
    grids: tuple[Grid, ...]
    data: dict[str, Json]
    """For results.json."""
    figures: dict[str, Callable[[], bytes]]
    """PNGs by the name of their file, drawn when asked for."""


def analyse(scene: SceneScores, truths: dict[Split, Truth], errors: list[HyalineError], *,
            order_layers: int) -> Further:  # fmt: skip
    """All analyses of a scored scene.

    Args:
        order_layers: layers by whose order pixels are told apart; 0 leaves that analysis out.
        truths: of the two test splits that every dataset has.
        errors: takes what is wrong with runs; the others are analysed.
    """
    grids: list[Grid] = []
    data: dict[str, Json] = {}
    figures: dict[str, Callable[[], bytes]] = {}
    name = file_name(scene.title)

    angle_truths = read_angle_truths(scene, errors)
    if by_angle := score_angles(scene, angle_truths, errors):
        grids.append(angle_grid(scene, angle_truths, by_angle))
        data["angle_splits"] = angles_json(angle_truths, by_angle)
    if curves := _curves(scene, truths | angle_truths, by_angle):
        pooled = pool_seeds(scene.runs, curves)
        grids.append(curve_grid(scene.title, pooled))
        data["curves"] = to_json(curves)
        figures[f"curve_{name}"] = lambda: curve_figure(scene.title, pooled)
    if budgets := find_budgets(scene):
        grids.append(budget_grid(scene.title, budgets))
        data["layer_budgets"] = to_json(budgets)
        figures[f"budget_{name}"] = lambda: budget_figure(scene.title, budgets)
    if scaled := score_scaled(scene, errors):
        grids.append(super_resolution_grid(scene, scaled))
        data["super_resolution"] = super_resolution_json(scaled)
    if edits := score_edits(scene, errors):
        grids += edit_grids(scene.title, edits, scene.runs)
        data["edits"] = [edit_json(edit) for edit in edits]
        figures |= {f"edit_{name}_{file_name(edit.edited.name)}": partial(edit_sheet, scene, edit) for edit in edits}
    if order_layers:
        order = score_order(scene, edits, order_layers)
        grids.append(order_grid(scene.title, order, scene.runs))
        data["order"] = order_json(order)
    return Further(title=scene.title, grids=tuple(grids), data=data, figures=figures)


def _curves(scene: SceneScores, truths: dict[Split, Truth], by_angle: dict[str, RunScores]) -> dict[str, Curve]:
    """The extrapolation curves by the run's name; none without straight layers."""
    if not scene.has_glass_mask:
        return {}
    say(f"{scene.title}: reads what the training views saw")
    coverage = read_coverage(scene.dataset)
    homes = homes_of_test_splits(scene.dataset)
    covered: dict[Split, tuple[PixelCoverage, ...]] = {
        split: tuple(cover_view(coverage, homes[split], split, view) for view in range(len(truth.images)))
        for split, truth in truths.items()
    }
    curves = {}
    for scores in track(scene.runs, label=f"curves of {scene.title}", total=len(scene.runs)):
        further = by_angle[scores.run.name].splits if scores.run.name in by_angle else {}
        predicted: dict[Split, tuple[PixelCoverage, ...]] = {
            split: covered[split] for split, values in (scores.splits | further).items() if values is not None
        }
        if predicted:
            curves[scores.run.name] = make_curve(scores.run, truths, predicted)
    return curves
