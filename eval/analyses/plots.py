"""The line plots of a report: SVG files, and charts in its page."""

from collections.abc import Callable, Mapping, Sequence

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.ticker import MaxNLocator, NullLocator

from datagen.pages.charts import GRID, STYLE, figure_svg, new_figure, page_figure
from datagen.pages.html import Markup
from eval.analyses.curve import ANGLE_EDGES, MIN_PIXELS, Bin, Curve

SIZE = 15, 6.4
"""Inches of a file."""
MARGINS = {"left": 0.12, "right": 0.97, "top": 0.98, "bottom": 0.13, "hspace": 0.08}
VIEW_TICKS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


@mpl.rc_context(STYLE)
def curve_figure(title: str, curves: dict[str, Curve]) -> bytes:
    """The SVG of all runs' PSNR by angle to the nearest training ray, and by the training views that saw the texel."""
    figure = Figure(figsize=SIZE, facecolor="white")
    top, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(2 + len(curves) // 3, 18)).flat
    left, right = below.subfigures(1, 2, squeeze=False).flat
    draw_by_angle(left, curves)
    draw_by_views(right, curves)
    names = [
        name if curve.db_per_10deg is None else f"{name} ({curve.db_per_10deg:+.1f} dB / 10°)"
        for name, curve in curves.items()
    ]
    top.text(0.02, 0.5, f"{title}: error against what training saw", fontsize=14, weight="bold", va="center")
    top.legend(left.axes[0].get_lines(), names, loc="right", ncols=3, frameon=False, fontsize=10)
    return figure_svg(figure)


@mpl.rc_context(STYLE)
def curve_charts(curves: dict[str, Curve]) -> list[Markup]:
    """The same in a page."""
    charts = []
    for draw, title in (
        (draw_by_angle, "PSNR by the angle to the nearest training ray"),
        (draw_by_views, "PSNR by the number of training views that saw the texel"),
    ):
        figure = new_figure(640, 400)
        draw(figure, curves)
        figure.legend(figure.axes[0].get_lines(), list(curves), loc="outside lower left", ncols=3, frameon=False)
        charts.append(page_figure(figure, title))
    return charts


def draw_by_angle(figure: FigureBase, curves: dict[str, Curve]) -> None:
    """PSNR by angle, and below it the shares of pixels.

    A triangle at the right edge marks pixels with texels that training never saw. Angles over 90 degrees are rare, and
    only in the table.
    """
    ends = [part.high for part in _fullest(curves).by_angle if part.high <= 90 and part.pixels >= MIN_PIXELS]
    end = max(ends, default=ANGLE_EDGES[1])
    scores, shares = _draw(
        figure,
        {name: [part for part in curve.by_angle if part.high <= end] for name, curve in curves.items()},
        lambda part: (part.low, part.high - part.low),
    )
    for line, curve in zip(scores.get_lines(), curves.values(), strict=True):
        if curve.unseen is not None and curve.unseen.pixels >= MIN_PIXELS:
            scores.scatter([end], [curve.unseen.psnr_db], s=80, marker="<", color=line.get_color(), clip_on=False)
    shares.set(xlim=(0, end), xlabel="angle to the nearest training ray (degrees)")


def draw_by_views(figure: FigureBase, curves: dict[str, Curve]) -> None:
    """PSNR by training views, and below it the shares of pixels."""
    bins = {name: curve.by_views for name, curve in curves.items()}
    _, shares = _draw(figure, bins, lambda part: (part.mean / 1.15, part.mean * 0.3))
    most = _fullest(curves).by_views[-1].mean
    shares.set(xscale="log", xlabel="training views that saw the texel")
    ticks = [tick for tick in VIEW_TICKS if tick <= 1.5 * most]
    shares.set_xticks(ticks, map(str, ticks))
    shares.xaxis.set_minor_locator(NullLocator())


def _draw(
    figure: FigureBase, bins: Mapping[str, Sequence[Bin]], bar_of: Callable[[Bin], tuple[float, float]]
) -> tuple[Axes, Axes]:
    """All curves, and below them the shares of pixels of the run with most pixels.

    Args:
        bins: by the run's name.
        bar_of: left end and width of a bin's bar.
    """
    scores, shares = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1), gridspec_kw=MARGINS)
    for name, of_run in bins.items():
        shown = [part for part in of_run if part.pixels >= MIN_PIXELS and part.mse > 0]
        scores.plot([part.mean for part in shown], [part.psnr_db for part in shown], label=name)
    fullest = max(bins.values(), key=lambda of_run: sum(part.pixels for part in of_run))
    total = sum(part.pixels for part in fullest)
    for part in fullest:
        left, width = bar_of(part)
        shares.bar(left, 100 * part.pixels / total, width, align="edge", color=GRID)
    scores.set(ylabel="PSNR (dB)")
    shares.set(ylabel="pixels (%)")
    shares.yaxis.set_major_locator(MaxNLocator(2))
    return scores, shares


def _fullest(curves: dict[str, Curve]) -> Curve:
    return max(curves.values(), key=lambda curve: sum(part.pixels for part in curve.by_angle))
