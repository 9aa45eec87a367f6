"""The report's parts beyond scores: the analyses of a scene with their tables and data, and all pictures.

matplotlib is imported only when a picture is drawn.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.variants import ANGLES, is_larger
from datagen.disk.errors import HyalineError
from datagen.disk.names import file_name
from datagen.disk.records import Json, to_json
from datagen.terminal.command import say, track
from eval.analyses.coverage import Coverage, PixelCoverage, cover_view, read_coverage
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
from eval.score.scores import RunScores, SceneScores, Truth
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
    truths = scene.truths | ({} if by_angle is None else by_angle.truths)
    covered = _Covered(scene, by_angle)
    curves = {}
    for scores in track(scene.runs, label=f"curves of {scene.title}", total=len(scene.runs)):
        drawn = [scores]
        if by_angle is not None and scores.run.name in by_angle.runs:
            drawn.append(by_angle.runs[scores.run.name])
        runs: dict[Split, RunScores] = {
            split: found for found in drawn for split, values in found.splits.items() if values is not None
        }
        if runs:
            curves[scores.run.name] = _make_curve(runs, truths, covered)
    return curves


def _make_curve(runs: dict[Split, RunScores], truths: dict[Split, Truth], covered: "_Covered") -> Curve:
    found: dict[Split, Run] = {split: scores.run for split, scores in runs.items()}
    seen: dict[Split, tuple[PixelCoverage, ...]] = {split: covered.split(split) for split in found}
    return make_curve(found, truths, seen)


class _Covered:
    """The training coverage of the test views, each read once."""

    def __init__(self, scene: SceneScores, by_angle: VariantScores | None) -> None:
        self._scene, self._by_angle = scene, by_angle
        self._by_split: dict[Split, tuple[PixelCoverage, ...]] = {}

    @functools.cached_property
    def _training(self) -> Coverage:
        say(f"{self._scene.title}: reading the coverage of the training views")
        return read_coverage(self._scene.dataset)

    def split(self, split: Split) -> tuple[PixelCoverage, ...]:
        if split not in self._by_split:
            home = _home(self._scene, self._by_angle, split)
            views = range(home.config.split(split).views)
            self._by_split[split] = tuple(cover_view(self._training, home, split, view) for view in views)
        return self._by_split[split]


def _home(scene: SceneScores, by_angle: VariantScores | None, split: Split) -> Dataset:
    """The dataset or the variant that has a split."""
    return by_angle.variant if by_angle is not None and split in by_angle.truths else scene.dataset


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
