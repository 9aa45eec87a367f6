"""The figure of quality against the error of a proxy."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from datagen.data.config import TEST_SPLITS
from eval.analyses.proxy_error import ProxyError
from eval.figures.sheets import DPI, figure_png
from eval.papers.comparisons import Entry


def ladder_figure(title: str, entries: Sequence[tuple[Entry, ProxyError]]) -> bytes:
    """The PNG of PSNR against the mean distance to the true surface, a panel a split, a line a method.

    Distances are on a logarithmic axis that begins with a linear piece, so that the truth has a place on it.
    """
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


COLORS = ("#1b6ca8", "#d9772b", "#2a8f4d", "#b23a48", "#7a5195")


MARKERS = ("o", "s", "^", "D", "v")
