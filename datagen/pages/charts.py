"""Line charts by matplotlib, as pictures in pages."""

import base64
import io
import math
from collections.abc import Sequence
from typing import Any

from datagen.disk.errors import printable
from datagen.pages.html import Markup, tag

COLORS = ("#1b6ca8", "#c7611a", "#2a8f4d", "#b23a48", "#7a5195", "#7f6a55", "#c2569b", "#5c6f7b")
"""Colours of lines and dots, in turn."""
SOFT, GRID = "#5a646e", "#d5dbe1"

STYLE: dict[Any, Any] = {
    "axes.facecolor": "none",
    "axes.labelcolor": SOFT,
    "axes.labelsize": 12,
    "axes.formatter.limits": (-7, 7),
    "axes.grid": True,
    "grid.color": GRID,
    "lines.linewidth": 2,
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
    **{f"{axis}tick.{name}": size for axis in "xy" for name, size in {"labelsize": 12, "major.size": 0}.items()},
    **{f"{axis}tick.labelcolor": SOFT for axis in "xy"},
}
"""matplotlib's style: a grid, titles and numbers in quiet colours, no frame."""

WIDTH, HEIGHT, DOTS = 640, 300, 72
"""Pixels, and how many SVG has an inch."""


def line_chart(points: Sequence[tuple[float, float]], *, title: str, x_title: str, y_title: str) -> Markup:
    """A page's figure of one line through pairs of x and y; those that are not finite leave gaps."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    if not any(math.isfinite(y) for _, y in points):
        return tag("p", f"{title}: nothing to draw.", class_="note")
    with mpl.rc_context({**STYLE, "svg.fonttype": "none", "svg.hashsalt": "hyaline"}):  # The same bytes every time.
        size = WIDTH / DOTS, HEIGHT / DOTS
        figure = Figure(figsize=size, dpi=DOTS, facecolor="white", layout="constrained")
        axes = figure.subplots()
        x, y = [x for x, _ in points], [y if math.isfinite(y) else math.nan for _, y in points]
        axes.plot(x, y, color=COLORS[0])
        # Names with two dollars are no formulas.
        axes.set_xlabel(printable(x_title), parse_math=False)
        axes.set_ylabel(printable(y_title), parse_math=False)
        axes.locator_params(axis="x", nbins=5)
        buffer = io.BytesIO()
        # matplotlib would write the time and its own version into the file.
        metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(buffer, format="svg", metadata=metadata)
    data = base64.b64encode(buffer.getvalue()).decode()
    picture = tag("img", class_="chart", src=f"data:image/svg+xml;base64,{data}", alt=title)
    return tag("figure", tag("figcaption", title), picture)
