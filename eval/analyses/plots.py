"""The line plots of a report."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from datagen.data.config import TEST_SPLITS
from eval.analyses.budget import Budget
from eval.analyses.curve import ANGLE_EDGES, MIN_PIXELS, Bin, Curve
from eval.figures.sheets import DPI, figure_png

COLORS = ("#1b6ca8", "#d9772b", "#2a8f4d", "#b23a48", "#7a5195", "#7f6a55", "#c2569b", "#5c6f7b")


def curve_figure(title: str, curves: dict[str, Curve]) -> bytes:
    """The PNG of all runs' PSNR by angle to the nearest training ray, and by how many training views saw the texel.

    A triangle at the right edge marks pixels with texels that training never saw. Below, the shares of pixels. Angles
    over 90 degrees, seldom and from the other side, are left to the table.
    """
    figure = Figure(figsize=(1500 / DPI, 640 / DPI), dpi=DPI, facecolor="white")
    panels = figure.subplots(2, 2, sharex="col", height_ratios=(4, 1), gridspec_kw={"hspace": 0.08, "wspace": 0.12})
    (by_angle, by_views), (angle_shares, views_shares) = panels
    fullest = max(curves.values(), key=lambda curve: sum(part.pixels for part in curve.by_angle))
    for place, (name, curve) in enumerate(curves.items()):
        color = COLORS[place % len(COLORS)]
        slope = "" if curve.db_per_10deg is None else f" ({curve.db_per_10deg:+.1f} dB / 10°)"
        _line(by_angle, _up_to_90(curve), color, f"{name}{slope}")
        _line(by_views, curve.by_views, color)
        if curve.unseen is not None and curve.unseen.pixels >= MIN_PIXELS:
            by_angle.plot([_right_end(fullest)], [curve.unseen.psnr_db], "<", color=color, markersize=9, clip_on=False)
    _shares(angle_shares, _up_to_90(fullest), lambda part: (part.low, part.high - part.low))
    _shares(views_shares, fullest.by_views, lambda part: (part.mean / 1.15, part.mean * 0.3))
    by_views.set_xscale("log")
    ticks = [tick for tick in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if tick <= 1.5 * fullest.by_views[-1].mean]
    views_shares.set_xticks(ticks, [str(tick) for tick in ticks])
    views_shares.xaxis.set_minor_locator(NullLocator())
    angle_shares.set(xlim=(0, _right_end(fullest)), xlabel="angle to the nearest training ray (degrees)")
    views_shares.set(xlabel="training views that saw the texel")
    for axes in (by_angle, by_views):
        axes.set_ylabel("PSNR (dB)")
    _head(figure, by_angle, f"{title}: error against what training saw")
    return figure_png(figure)


def budget_figure(title: str, budgets: tuple[Budget, ...]) -> bytes:
    """The PNG of PSNR by the number of layers, and of the shares of rays that these leave out, for both test splits."""
    figure = Figure(figsize=(1500 / DPI, 640 / DPI), dpi=DPI, facecolor="white")
    panels = figure.subplots(
        2, 2, sharex=True, sharey="row", height_ratios=(2, 1), gridspec_kw={"hspace": 0.08, "wspace": 0.06}
    )
    for column, split in enumerate(TEST_SPLITS):
        scores, shares = panels[:, column]
        for place, budget in enumerate(budgets):
            color, layers = COLORS[place % len(COLORS)], [point.num_layers for point in budget.points]
            psnr = [np.nan if (value := point.psnr_db[split]) is None else value for point in budget.points]
            scores.plot(layers, psnr, "o-", color=color, label=None if column else budget.name)
            for values, style, what in (("more_share", ":", "more surfaces"), ("deeper_share", "-", "deeper sight")):
                percent = [100 * getattr(point, values)[split] for point in budget.points]
                shares.plot(layers, percent, f"o{style}", color=color, markersize=3)
                if place == 0:
                    shares.annotate(what, (layers[0], percent[0]), (4, 4), textcoords="offset points", fontsize=9)
        for axes in (scores, shares):
            axes.grid(color="0.92")
            axes.set_axisbelow(True)
        shares.xaxis.set_major_locator(MaxNLocator(integer=True))
        shares.set(xlabel=f"layers, {split}", ylim=(-6, 122), yticks=(0, 50, 100))
    panels[0, 0].set_ylabel("PSNR (dB)")
    panels[1, 0].set_ylabel("rays (%)")
    _head(figure, panels[0, 0], f"{title}: layer budget")
    return figure_png(figure)


def _head(figure: Figure, axes: Axes, title: str) -> None:
    """A title on the left, and on the right the legend of the lines in `axes`."""
    rows = -(-len(axes.get_legend_handles_labels()[1]) // 3)
    figure.subplots_adjust(left=0.05, right=0.985, top=0.955 - 0.035 * rows, bottom=0.09)
    figure.legend(loc="upper right", bbox_to_anchor=(0.99, 0.995), ncols=3, frameon=False, fontsize=10)
    figure.text(0.02, 0.95, title, fontsize=14, weight="bold")


def _line(axes: Axes, bins: Sequence[Bin], color: str, label: str | None = None) -> None:
    shown = [part for part in bins if part.pixels >= MIN_PIXELS and part.mse > 0]
    axes.plot(
        [part.mean for part in shown], [part.psnr_db for part in shown], "o-", color=color, label=label, markersize=4
    )
    axes.grid(color="0.92")
    axes.set_axisbelow(True)


def _shares(axes: Axes, bins: Sequence[Bin], place: Callable[[Bin], tuple[float, float]]) -> None:
    total = sum(part.pixels for part in bins)
    left, width = np.array([place(part) for part in bins]).T
    axes.bar(left, [100 * part.pixels / total for part in bins], width, align="edge", color="0.75", edgecolor="white")
    axes.set_ylabel("pixels (%)")


def _right_end(curve: Curve) -> float:
    """The upper end of the last bin of angles that a line reaches."""
    ends = [part.high for part in _up_to_90(curve) if part.pixels >= MIN_PIXELS]
    return max(ends, default=ANGLE_EDGES[1])


def _up_to_90(curve: Curve) -> list[Bin]:
    return [part for part in curve.by_angle if part.high <= 90]
