"""Line charts by matplotlib, as pictures in pages."""

import base64
import functools
import io
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from datagen.disk.errors import printable
from datagen.pages.html import Markup, tag

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#1b6ca8", "#c7611a", "#2a8f4d", "#b23a48", "#7a5195", "#7f6a55", "#c2569b", "#5c6f7b")
DASHES = ("-", "--", ":", "-.")
"""Line styles, in turn: every eight lines the dash changes. The colours are `--s0` to `--s7` of page.css in its light
theme."""
SOFT, GRID = "#5a646e", "#d5dbe1"

STYLE: dict[Any, Any] = {
    "axes.prop_cycle": f"cycler('linestyle', {list(DASHES)}) * cycler('color', {list(COLORS)})",
    "axes.facecolor": "none",
    "axes.labelcolor": SOFT,
    "axes.labelsize": 12,
    "axes.labelpad": 8,
    "axes.formatter.limits": (-7, 7),
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "lines.linewidth": 2,
    "lines.marker": "o",
    "lines.markersize": 5,
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
    **{f"{axis}tick.{name}": size for axis in "xy" for name, size in {"labelsize": 12, "major.size": 0}.items()},
    **{f"{axis}tick.labelcolor": SOFT for axis in "xy"},
}
"""matplotlib's style: a grid, titles and numbers in quiet colours, no frame."""

WIDTH, HEIGHT, DOTS = 640, 300, 72
"""Pixels, and how many SVG has an inch."""
MOST_MARKED = 40
"""Lines with more points are drawn without dots, which would touch each other."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """One line of a chart."""

    name: str
    points: tuple[tuple[float, float], ...]
    """Pairs of x and y, in order of x."""


@functools.cache  # A report is drawn again with fewer pictures until it is small enough.
def line_chart(lines: tuple[Line, ...], *, title: str, x_title: str, y_title: str) -> Markup:
    """A page's figure with a legend; points that are not finite leave gaps."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    if not any(math.isfinite(y) for line in lines for _, y in line.points):
        return tag("p", f"{title}: nothing to draw.", class_="note")
    with mpl.rc_context({**STYLE, "svg.fonttype": "none", "svg.hashsalt": "hyaline"}):  # The same bytes every time.
        size = WIDTH / DOTS, HEIGHT / DOTS
        figure = Figure(figsize=size, dpi=DOTS, facecolor="white", layout="constrained")
        axes = figure.subplots()
        for line in lines:
            x, y = [x for x, _ in line.points], [y if math.isfinite(y) else math.nan for _, y in line.points]
            axes.plot(x, y, label=printable(line.name), marker="o" if len(x) <= MOST_MARKED else "")
        axes.set(xlabel=printable(x_title), ylabel=printable(y_title))
        axes.locator_params(axis="x", nbins=5)
        figure.legend(loc="outside lower left", ncols=3, frameon=False)
        names_as_they_are(figure)
        buffer = io.BytesIO()
        # matplotlib would write the time and its own version into the file.
        metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(buffer, format="svg", metadata=metadata)
    data = base64.b64encode(buffer.getvalue()).decode()
    picture = tag("img", class_="chart", src=f"data:image/svg+xml;base64,{data}", alt=title)
    return tag("figure", tag("figcaption", title), picture)


def names_as_they_are(figure: "Figure") -> None:
    """Stops matplotlib from reading names with two dollars as formulas; ticks of logarithmic axes stay formulas."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        if isinstance(text, Text) and not text.get_text().startswith(r"$\mathdefault{"):
            text.set_parse_math("$" not in text.get_text())
