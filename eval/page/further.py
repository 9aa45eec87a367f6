"""The analyses of a scene that a report shows beyond the scores: their tables, data and figures."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.variants import ANGLES, is_larger
from datagen.disk.errors import HyalineError
from datagen.disk.names import file_name
from datagen.disk.records import Json, to_json
from datagen.terminal.command import say, track
from eval.analyses.angles import angle_grid
from eval.analyses.budget import budget_grid, find_budgets
from eval.analyses.coverage import PixelCoverage, cover_view, read_coverage
from eval.analyses.curve import Curve, curve_grid, make_curve, pool_seeds
from eval.analyses.edit_sheet import edit_sheet
from eval.analyses.edit_tables import edit_grids, edit_json, order_grid, order_json
from eval.analyses.edits import EditScores, score_edits
from eval.analyses.order import score_order
from eval.analyses.plots import budget_figure, curve_figure
from eval.analyses.super_resolution import score_enlarged, super_resolution_grid, super_resolution_json
from eval.analyses.variants import VariantScores, score_variants, variant_json
from eval.score.runs import Run
from eval.score.scores import SceneScores, Truth
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
    curves: dict[str, Curve]
    """By the run's name, over seeds where there are several."""
    variants: tuple[VariantScores, ...]
    edits: tuple[EditScores, ...]


def analyse(
    scene: SceneScores, truths: dict[Split, Truth], errors: list[HyalineError], *, order_layers: int
) -> Further:
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

    variants = score_variants(scene, errors)
    by_name: dict[str, Json] = {}
    by_angle = next((scored for scored in variants if scored.variant.name == ANGLES), None)
    if by_angle is not None:
        grids.append(angle_grid(scene, by_angle))
        by_name[ANGLES] = variant_json(by_angle)
    pooled: dict[str, Curve] = {}
    if curves := _curves(scene, truths, by_angle):
        pooled = pool_seeds(scene.runs, curves)
        grids.append(curve_grid(scene.title, pooled))
        data["curves"] = to_json(curves)
        figures[f"curve_{name}"] = lambda: curve_figure(scene.title, pooled)
    if budgets := find_budgets(scene):
        grids.append(budget_grid(scene.title, budgets))
        data["layer_budgets"] = to_json(budgets)
        figures[f"budget_{name}"] = lambda: budget_figure(scene.title, budgets)
    if larger := [(scored, score_enlarged(scene, scored)) for scored in variants if is_larger(scored.variant)]:
        grids.append(super_resolution_grid(scene, larger))
        by_name |= {scored.variant.name: super_resolution_json(scored, enlarged) for scored, enlarged in larger}
    if edits := score_edits(scene, variants, errors):
        grids += edit_grids(scene.title, edits, scene.runs)
        by_name |= {edit.edited.name: edit_json(edit) for edit in edits}
        figures |= {f"edit_{name}_{file_name(edit.edited.name)}": partial(edit_sheet, scene, edit) for edit in edits}
    if by_name:
        data["variants"] = by_name
    if order_layers:
        order = score_order(scene, edits, order_layers)
        grids.append(order_grid(scene.title, order, scene.runs))
        data["order"] = order_json(order)
    return Further(
        title=scene.title,
        grids=tuple(grids),
        data=data,
        figures=figures,
        curves=pooled,
        variants=tuple(variants),
        edits=edits,
    )


def _curves(scene: SceneScores, truths: dict[Split, Truth], by_angle: VariantScores | None) -> dict[str, Curve]:
    """The extrapolation curves by the run's name; none without straight layers."""
    if not scene.has_glass_mask:
        return {}
    say(f"{scene.title}: reads what the training views saw")
    coverage = read_coverage(scene.dataset)
    if by_angle is not None:
        truths = truths | by_angle.truths
    covered: dict[Split, tuple[PixelCoverage, ...]] = {
        split: tuple(
            cover_view(coverage, _home(scene, by_angle, split), split, view) for view in range(len(truth.images))
        )
        for split, truth in truths.items()
    }
    curves = {}
    for scores in track(scene.runs, label=f"curves of {scene.title}", total=len(scene.runs)):
        drawn = [scores]
        if by_angle is not None and scores.run.name in by_angle.runs:
            drawn.append(by_angle.runs[scores.run.name])
        runs: dict[Split, Run] = {
            split: found.run for found in drawn for split, values in found.splits.items() if values is not None
        }
        if runs:
            curves[scores.run.name] = make_curve(runs, truths, {split: covered[split] for split in runs})
    return curves


def _home(scene: SceneScores, by_angle: VariantScores | None, split: Split) -> Dataset:
    """The dataset or the variant that has a split."""
    return by_angle.variant if by_angle is not None and split in by_angle.truths else scene.dataset
