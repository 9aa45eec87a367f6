"""Line charts by matplotlib: as SVG files, and inside pages, where they take the colours of the page's theme."""

import functools
import io
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from datagen.disk.names import printable
from datagen.pages.html import Markup, join, tag

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#1b6ca8", "#c7611a", "#2a8f4d", "#b23a48", "#7a5195", "#7f6a55", "#c2569b", "#5c6f7b")
DASHES = ("-", "--", ":", "-.")
"""Line styles, in turn. The colours are `--s0` to `--s7` of page.css in its light theme; every eight lines the dash
changes, to `d1`, `d2` and `d3`."""
SOFT, GRID = "#5a646e", "#d5dbe1"
THEME = {**{color: f"var(--s{place})" for place, color in enumerate(COLORS)}, SOFT: "var(--soft)", GRID: "var(--line)"}

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

WIDTH, HEIGHT = 640, 300
MARGINS = {"left": 76 / WIDTH, "right": 1 - 36 / WIDTH, "top": 1 - 12 / HEIGHT, "bottom": 48 / HEIGHT}
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

    if not any(math.isfinite(y) for line in lines for _, y in line.points):
        return tag("p", f"{title}: nothing to draw.", class_="note")
    with mpl.rc_context(STYLE):
        figure = new_figure(WIDTH, HEIGHT)
        axes = figure.subplots(gridspec_kw=MARGINS)
        for line in lines:
            x, y = [x for x, _ in line.points], [y if math.isfinite(y) else math.nan for _, y in line.points]
            axes.plot(x, y, label=line.name, marker="o" if len(x) <= MOST_MARKED else "")
        axes.set(xlabel=printable(x_title), ylabel=printable(y_title))
        axes.locator_params(axis="x", nbins=5)
        return page_figure(figure, title)


def new_figure(width: int, height: int) -> "Figure":
    """An empty figure for a page; sizes are pixels."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width / 72, height / 72), dpi=72, facecolor="none")  # SVG has 72 pixels an inch.


def page_figure(figure: "Figure", title: str) -> Markup:
    """A figure as a part of a page, with a legend of the lines in its first axes.

    Args:
        title: the caption, also read by screen readers.
    """
    root = ElementTree.fromstring(figure_svg(figure, is_outlined=False))
    shapes = {element.get("id", ""): element for element in root.iter()}
    parts = (tag("title", title), *(_inline(child, shapes) for child in root))
    frame = root.get("viewBox")
    drawing = tag("svg", *parts, class_="chart", viewBox=frame, role="img", aria_label=title)
    legend = [
        tag("li", tag("span", str(line.get_label())), class_=_legend_class(place))
        for place, line in enumerate(figure.axes[0].get_lines())
        if np.size(line.get_xdata())  # Empty lines are not drawn.
    ]
    return tag("figure", tag("figcaption", title), drawing, tag("ul", *legend, class_="legend"))


def figure_svg(figure: "Figure", *, is_outlined: bool = True) -> bytes:
    """The figure as SVG; the same figure always gives the same bytes.

    Args:
        is_outlined: draw letters as outlines, which look the same everywhere, instead of text.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    names_as_they_are(figure)
    buffer = io.BytesIO()
    with mpl.rc_context({"svg.fonttype": "path" if is_outlined else "none", "svg.hashsalt": "hyaline"}):
        # matplotlib would write the time and its own version into the file.
        FigureCanvasSVG(figure).print_svg(buffer, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return buffer.getvalue()


def names_as_they_are(figure: "Figure") -> None:
    """Stops matplotlib from reading names with two dollars as formulas; ticks of logarithmic axes stay formulas."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        if isinstance(text, Text) and not text.get_text().startswith(r"$\mathdefault{"):
            text.set_parse_math("$" not in text.get_text())


def _inline(element: ElementTree.Element, shapes: dict[str, ElementTree.Element]) -> Markup | None:
    """matplotlib's element without styles, which the page's policy forbids, and without ids, which must be unique."""
    kind = element.tag.rpartition("}")[2]
    if kind == "g":
        return join(_inline(child, shapes) for child in element)
    if kind not in ("path", "text", "use"):
        return None
    style = dict(pair.split(": ") for pair in element.get("style", "").split("; ") if pair)
    style = {name.replace("-", "_"): THEME.get(value, value) for name, value in style.items()}
    if kind == "text":
        place = {name: element.get(name) for name in ("x", "y", "transform")}
        return tag("text", element.text, text_anchor=style.get("text_anchor"), **place)
    shape, place = element, None
    if kind == "use":
        shape = shapes[element.get("{http://www.w3.org/1999/xlink}href", "")[1:]]
        place = f"translate({element.get('x')} {element.get('y')})"
    return tag("path", d=_short(shape.get("d", "")), transform=place, **style)


def _short(path: str) -> str:
    """A path with numbers rounded to a hundredth of a pixel."""
    return " ".join(f"{round(float(word), 2):g}" if word[-1].isdigit() else word for word in path.split())


def _legend_class(place: int) -> str:
    dash = place // len(COLORS) % len(DASHES)
    return f"s{place % len(COLORS)}" + (f" d{dash}" if dash else "")
