"""The layer budget: scores of runs that differ in how many layers they are given, and what those layers miss."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from datagen.disk.records import Json, from_json
from datagen.disk.storage import dump_json
from eval.analyses.coverage import visible_layers
from eval.score.kept import Kept, layers_digest
from eval.score.metrics import mean_of
from eval.score.runs import Run
from eval.score.scores import RunScores, SceneScores
from eval.tables.grids import Column, Grid, format_number

FREE_KEYS = ("layers", "width", "seed")
"""Keys of a configuration in which runs of one budget may differ: the layers; the width that keeps the number of
parameters the same when they do; and the seed, over which scores are averaged."""

MOST_GROWTH = 1.25
"""From one network of a budget to the next in size; the default width keeps them within a twentieth."""

BUDGET_NOTES = (
    "Layers: straight layers that the network is given, the nearest ones. More: share of the test rays that meet more "
    "surfaces. Deeper: share that sees a surface beyond them, through nothing but glass (where all stored layers are "
    "given: share that meets nothing but glass in all of them).",
)


@dataclass(frozen=True, kw_only=True)
class BudgetPoint:
    """One number of layers; scores are means over the runs, which differ in their seeds."""

    num_layers: int
    runs: tuple[str, ...]
    num_parameters: int | None
    psnr_db: dict[Split, float | None]
    glass_psnr_db: dict[Split, float | None]
    more_share: dict[Split, float]
    """Share of the split's rays that meet more surfaces than so many."""
    deeper_share: dict[Split, float]
    """Share of the split's rays to whose colour a surface behind the last layer contributes."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Runs that differ in nothing but their number of layers (and what follows from it), fewest layers first."""

    name: str
    """Of the run with most layers."""
    points: tuple[BudgetPoint, ...]


def find_budgets(scene: SceneScores, kept: Kept) -> tuple[Budget, ...]:
    """The budgets among a scene's runs: at least two numbers of layers each."""
    groups: dict[bytes, list[RunScores]] = defaultdict(list)
    for scores in scene.runs:
        if scores.run.num_layers is not None:
            groups[_likeness(scores.run)].append(scores)
    budgets = []
    for group in (part for alike in groups.values() for part in _of_one_size(alike)):
        by_layers: dict[int, list[RunScores]] = defaultdict(list)
        for scores in group:
            by_layers[scores.run.num_layers or 0].append(scores)
        if len(by_layers) > 1:
            name = by_layers[max(by_layers)][0].run.name
            shares = _kept_shares(scene.dataset, group[0].run.geometry or TRUTH, sorted(by_layers), kept)
            points = tuple(_point(count, by_layers[count], *shares[count]) for count in sorted(by_layers))
            budgets.append(Budget(name=name, points=points))
    return tuple(budgets)


Shares = dict[Split, float]


def _kept_shares(dataset: Dataset, geometry: str, counts: list[int], kept: Kept) -> dict[int, tuple[Shares, Shares]]:
    def compute() -> Json:
        found = missed_shares(dataset, geometry, counts)
        return [[[shares[split] for split in TEST_SPLITS] for shares in found[count]] for count in counts]

    about: Json = [dataset.seal, layers_digest(dataset, geometry, TEST_SPLITS), list[Json](counts)]
    data = from_json(
        tuple[tuple[tuple[float, ...], ...], ...], kept.get("layer budget", about, compute), where="kept shares"
    )
    pairs = [tuple(dict(zip(TEST_SPLITS, values, strict=True)) for values in pair) for pair in data]
    return {count: (more, deeper) for count, (more, deeper) in zip(counts, pairs, strict=True)}


def missed_shares(dataset: Dataset, geometry: str, counts: list[int]) -> dict[int, tuple[Shares, Shares]]:
    """Shares of the test rays that meet more surfaces than so many, and that see deeper than so many.

    Raises:
        HyalineError: the geometry has no straight layers.
    """
    is_glass = np.array([False, *(item.is_glass for item in dataset.objects)])
    head = dataset.layer_store(geometry).head
    shares: dict[int, tuple[Shares, Shares]] = {count: ({}, {}) for count in counts}
    for split in TEST_SPLITS:
        more, deeper = ({count: [] for count in counts} for _ in range(2))
        for view in range(dataset.config.split(split).views):
            layers = dataset.view(split, view).layers(geometry)
            met = (layers.object_id > 0).sum(axis=0)
            visible = visible_layers(layers, is_glass).sum(axis=0)
            never_stopped = is_glass[layers.object_id].all(axis=0)
            overflow = dataset.layer_store(geometry).record(split, view).overflow_share
            for count in counts:
                more[count].append(overflow if count >= head.num_layers else np.mean(met > count))
                deeper[count].append(np.mean(never_stopped if count >= head.num_layers else visible > count))
        for count in counts:
            shares[count][0][split] = float(np.mean(more[count]))
            shares[count][1][split] = float(np.mean(deeper[count]))
    return shares


def budget_grid(title: str, budgets: tuple[Budget, ...]) -> Grid:
    """The table of a scene's budgets."""
    groups = ("PSNR dB ↑", "PSNR glass dB ↑", "more %", "deeper %")
    columns = [
        Column(group="budget", is_number=False),
        Column(group="layers"),
        Column(group="runs"),
        Column(group="parameters"),
    ]
    columns += [Column(group=group, split=split) for group in groups for split in TEST_SPLITS]
    rows = []
    for budget in budgets:
        for point in budget.points:
            parameters = "" if point.num_parameters is None else f"{point.num_parameters:,}"
            scores = [point.psnr_db, point.glass_psnr_db]
            shares = [point.more_share, point.deeper_share]
            rows.append(
                (
                    budget.name,
                    str(point.num_layers),
                    str(len(point.runs)),
                    parameters,
                    *(format_number(values[split], 2) for values in scores for split in TEST_SPLITS),
                    *(f"{100 * values[split]:.1f}" for values in shares for split in TEST_SPLITS),
                )
            )
    return Grid(
        title=f"{title}: layer budget", columns=tuple(columns), rows=tuple(rows), notes=BUDGET_NOTES, is_detail=True
    )


def _point(count: int, group: list[RunScores], more: Shares, deeper: Shares) -> BudgetPoint:
    def means(key: str) -> dict[Split, float | None]:
        return {split: mean_of([scores.mean(key, split) for scores in group]) for split in TEST_SPLITS}

    return BudgetPoint(
        num_layers=count,
        runs=tuple(scores.run.name for scores in group),
        num_parameters=group[0].run.num_parameters,
        psnr_db=means("psnr_db"),
        glass_psnr_db=means("glass_psnr_db"),
        more_share=more,
        deeper_share=deeper,
    )


def _of_one_size(group: list[RunScores]) -> list[list[RunScores]]:
    """The group, taken apart where parameters jump: a wider network is another budget, whatever its layers."""

    def size(scores: RunScores) -> int:
        return scores.run.num_parameters or 0

    parts: list[list[RunScores]] = []
    for scores in sorted(group, key=size):
        if not parts or size(scores) > MOST_GROWTH * size(parts[-1][-1]):
            parts.append([])
        parts[-1].append(scores)
    return parts


def _likeness(run: Run) -> bytes:
    """Equal for runs of one budget."""
    return dump_json({"method": run.method, "geometry": run.geometry, "config": _without_free_keys(run.config or {})})


def _without_free_keys(data: Json) -> Json:
    if not isinstance(data, dict):
        return data
    return {key: _without_free_keys(value) for key, value in data.items() if key not in FREE_KEYS}
