"""The proxy ladder: quality against how far a geometry is from the truth, as a table and as a figure."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import Dataset
from datagen.data.geometries import read_proxy_records
from datagen.data.paths import TRUTH, is_fitted
from datagen.pages.charts import COLORS
from eval.papers.comparisons import (
    NOT_RUN,
    SCORES,
    WRAPPED_NOTE,
    Comparison,
    Entry,
    Line,
    data_note,
    find_entries,
    score_cells,
)
from eval.papers.tables import BEST
from eval.score.scores import SceneScores
from eval.score.seeds import group_seeds
from eval.tables.grids import MISSING, Column, Grid
from eval.tables.named import Table

LADDER = Comparison(
    title="Quality against the proxy's error",
    lines=(
        Line(title="light-path", method="light-path", flags={}, geometry=None),
        dataclasses.replace(BEST, geometry=None),
        Line(title="paper", method="paper", flags={}, geometry=None),
    ),
    varied="geometry",
)

MARKERS = ("o", "s", "^", "D", "v")


@dataclass(frozen=True, kw_only=True)
class ProxyError:
    """How far a geometry is from the true surfaces."""

    mean_mm: float
    """Mean over objects of the mean distance from points on an object's proxy to its surface, in millimetres."""
    max_mm: float
    """Largest such distance of any object, in millimetres."""


def proxy_error(dataset: Dataset, geometry: str) -> ProxyError:
    """The error of a geometry, as measured when it was made; 0 for the truth."""
    if geometry == TRUTH:
        return ProxyError(mean_mm=0.0, max_mm=0.0)
    numbers = [record.statistics for record in read_proxy_records(dataset, geometry) if record.statistics]
    return ProxyError(
        mean_mm=1000 * math.fsum(item.mean_distance for item in numbers) / len(numbers),
        max_mm=1000 * max(item.max_distance for item in numbers),
    )


def find_ladder(scene: SceneScores) -> list[tuple[Entry, ProxyError]]:
    """The runs of the proxy ladder, method by method, the geometry nearest to the truth first.

    Fitted glass is left out: `model fit` does not measure its distance from the truth.
    """
    measured = [scores for scores in scene.runs if not is_fitted(scores.run.geometry or "")]
    entries = [entry for part in find_entries(LADDER, group_seeds(measured)) for entry in part]
    with_errors = [(entry, proxy_error(scene.dataset, entry.group.first.geometry or "")) for entry in entries]
    return sorted(with_errors, key=lambda pair: (LADDER.lines.index(pair[0].line), pair[1].mean_mm))


def ladder_grid(scene: SceneScores) -> Grid:
    """Each method on each geometry, and how far that is from the truth."""
    rows = []
    for entry, error in find_ladder(scene):
        group = entry.group
        rows.append(
            (
                entry.line.title,
                group.first.geometry or MISSING,
                str(len(group.runs)),
                f"{error.mean_mm:.2f}",
                f"{error.max_mm:.1f}",
                *score_cells(group),
            )
        )
    empty = [line for line in LADDER.lines if line.title not in {row[0] for row in rows}]
    rows += [(line.title, NOT_RUN, *[MISSING] * 8) for line in empty]
    texts, numbers = ("method", "geometry"), ("seeds", "mean distance mm", "max distance mm")
    return Grid(
        title=f"{scene.title}: {LADDER.title}",
        columns=(
            *(Column(group=text, is_number=False) for text in texts),
            *(Column(group=number) for number in numbers),
            *SCORES,
        ),
        rows=tuple(rows),
        notes=(
            "Mean distance: from points on an object's proxy to its true surface, then the mean over objects; max: of "
            "any object.",
            WRAPPED_NOTE,
            data_note(scene),
        ),
    )


def _picture(scene: SceneScores) -> bytes | None:
    ladder = find_ladder(scene)
    return ladder_figure(scene.title, ladder) if ladder else None


def ladder_figure(title: str, entries: Sequence[tuple[Entry, ProxyError]]) -> bytes:
    """The PNG of PSNR against the mean distance to the true surface, a panel a split, a line a method.

    Distances are on a logarithmic axis that begins with a linear piece, so that the truth has a place on it.
    """
    from matplotlib.figure import Figure

    from eval.figures import DPI, figure_png

    figure = Figure(figsize=(1500 / DPI, 620 / DPI), dpi=DPI, facecolor="white")
    panels = figure.subplots(1, 2, sharey=True)
    smallest = min((error.mean_mm for _, error in entries if error.mean_mm > 0), default=1.0)
    methods = list(dict.fromkeys(entry.line.title for entry, _ in entries))
    for panel, split in zip(panels, TEST_SPLITS, strict=True):
        for place, method in enumerate(methods):
            own = [
                (error.mean_mm, entry.group.score("psnr_db", split))
                for entry, error in entries
                if entry.line.title == method
            ]
            points = sorted(
                (distance, score.mean, score.deviation or 0.0)
                for distance, score in own
                if score.mean is not None and math.isfinite(score.mean)
            )
            if not points:
                continue
            distances, means, deviations = (np.array([point[axis] for point in points]) for axis in range(3))
            style = {"color": COLORS[place % len(COLORS)], "marker": MARKERS[place % len(MARKERS)], "label": method}
            panel.errorbar(distances, means, yerr=deviations, linewidth=1.5, markersize=6, capsize=3, **style)
        for geometry, distance in {entry.group.first.geometry: error.mean_mm for entry, error in entries}.items():
            panel.axvline(distance, color="0.9", linewidth=1, zorder=0)
            panel.annotate(
                f" {geometry}",
                (distance, 0),
                xycoords=panel.get_xaxis_transform(),
                rotation=90,
                ha="right",
                va="bottom",
                fontsize=9,
                color="0.35",
            )
        panel.set_xscale("symlog", linthresh=smallest, linscale=0.4)
        largest = max(error.mean_mm for _, error in entries)
        panel.set_xlim(-0.3 * smallest, 2.5 * max(largest, smallest))
        panel.margins(y=0.25)  # Room for the names.
        panel.set_title(split, fontsize=11)
        panel.set_xlabel("mean distance of the proxy from the true surface (mm)")
        panel.grid(axis="y", color="0.92")
        panel.set_axisbelow(True)
    panels[0].set_ylabel("PSNR (dB)")
    panels[0].legend(frameon=False)
    figure.suptitle(f"{title}: quality against the proxy's error", x=0.02, ha="left", fontsize=14, weight="bold")
    figure.tight_layout()
    return figure_png(figure)


PROXIES = Table(
    shows=lambda run: any(line.fits(run) for line in LADDER.lines),
    grids=lambda scenes, _: [ladder_grid(scene) for scene in scenes],
    picture=_picture,
    needs_more=True,
)
