"""Line charts as inline SVG: axes, lines, and points that say what they are when one points at them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from datagen.pages.html import Markup, Part, join, tag

WIDTH, HEIGHT = 640, 300
LEFT, RIGHT, TOP, BOTTOM = 64, 36, 12, 44
COLORS, DASHES = 8, 4
"""Classes s0 to s7 of the style, and d1 to d3: what comes after eight lines is dashed."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """One line of a chart."""

    name: str
    points: tuple[tuple[float, float], ...]
    """x and y, by rising x."""
    labels: tuple[str, ...] = ()
    """What is said of each point; its numbers unless given."""


def line_chart(lines: Sequence[Line], *, title: str, x_title: str, y_title: str, is_log_x: bool = False) -> Markup:
    """A figure with a legend; lines without a finite point are not drawn.

    Args:
        title: what the chart shows, for screen readers too.
        is_log_x: needs x above 0.
    """
    drawn = [(place, line) for place, line in enumerate(lines) if any(map(_is_finite, line.points))]
    if not drawn:
        return tag("p", f"{title}: nothing to draw.", class_="note")
    points = [point for _, line in drawn for point in line.points if _is_finite(point)]
    x_axis = _Axis([x for x, _ in points], LEFT, WIDTH - RIGHT, is_log=is_log_x)
    y_axis = _Axis([y for _, y in points], HEIGHT - BOTTOM, TOP)
    parts: list[Part] = [tag("title", title), *_grid(x_axis, y_axis, x_title, y_title)]
    for place, line in drawn:
        parts.append(_line(line, _style(place), x_axis, y_axis))
    chart = tag("svg", *parts, class_="chart", viewBox=f"0 0 {WIDTH} {HEIGHT}", role="img", aria_label=title)
    legend = tag(
        "ul", *(tag("li", tag("span", line.name), class_=_style(place)) for place, line in drawn), class_="legend"
    )
    return tag("figure", tag("figcaption", title), chart, legend)


def _style(place: int) -> str:
    dash = place // COLORS % DASHES
    return f"s{place % COLORS}" + (f" d{dash}" if dash else "")


class _Axis:
    """Where values stand along one side of a chart."""

    def __init__(self, values: list[float], start: float, end: float, *, is_log: bool = False) -> None:
        self._is_log = is_log
        low, high = min(values), max(values)
        if is_log:
            self.ticks = [tick for tick in _log_ticks(high) if low / 1.5 <= tick <= high * 1.5] or [low]
            margin = 1.1
            low, high = min(low, self.ticks[0]) / margin, max(high, self.ticks[-1]) * margin
        else:
            step = _step((high - low) or abs(high) or 1)
            low, high = math.floor(low / step) * step, math.ceil(high / step) * step
            high = high if high > low else low + step
            self.ticks = [low + place * step for place in range(round((high - low) / step) + 1)]
        self._low, self._high = self._scaled(low), self._scaled(high)
        self._start, self._end = start, end

    def __call__(self, value: float) -> float:
        share = (self._scaled(value) - self._low) / (self._high - self._low)
        return round(self._start + share * (self._end - self._start), 1)

    def _scaled(self, value: float) -> float:
        return math.log10(value) if self._is_log else value


def _grid(x_axis: _Axis, y_axis: _Axis, x_title: str, y_title: str) -> list[Part]:
    parts: list[Part] = []
    for tick in y_axis.ticks:
        y = y_axis(tick)
        parts.append(tag("line", x1=LEFT, x2=WIDTH - RIGHT, y1=y, y2=y, class_="grid"))
        parts.append(tag("text", _number(tick), x=LEFT - 6, y=y + 4, text_anchor="end"))
    for tick in x_axis.ticks:
        x = x_axis(tick)
        parts.append(tag("line", x1=x, x2=x, y1=HEIGHT - BOTTOM, y2=HEIGHT - BOTTOM + 4, class_="tick"))
        parts.append(tag("text", _number(tick), x=x, y=HEIGHT - BOTTOM + 18, text_anchor="middle"))
    middle = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(tag("text", x_title, x=(LEFT + WIDTH - RIGHT) / 2, y=HEIGHT - 6, text_anchor="middle"))
    parts.append(tag("text", y_title, x=0, y=0, text_anchor="middle", transform=f"translate(14 {middle}) rotate(-90)"))
    return parts


def _line(line: Line, style: str, x_axis: _Axis, y_axis: _Axis) -> Markup:
    places = [(x_axis(x), y_axis(y)) if _is_finite((x, y)) else None for x, y in line.points]
    pieces: list[str] = []
    for place, before in zip(places, [None, *places], strict=False):
        if place is not None:
            pieces.append(f"{'L' if before is not None else 'M'}{place[0]} {place[1]}")
    dots = []
    for number, place in enumerate(places):
        if place is not None:
            x, y = line.points[number]
            said = line.labels[number] if line.labels else f"{_number(x)}: {_number(y)}"
            dots.append(tag("g", tag("title", f"{line.name}, {said}"), tag("circle", cx=place[0], cy=place[1], r=3.5)))
    return tag("g", tag("path", d=" ".join(pieces)), join(dots), class_=f"line {style}")


def _step(extent: float) -> float:
    """A round step that parts an extent into three to eight."""
    raw = extent / 5
    size = 10.0 ** math.floor(math.log10(raw))
    return size * next(round_one for round_one in (1, 2, 5, 10) if round_one * size >= raw * 0.99)


def _log_ticks(high: float) -> list[float]:
    decades = range(-3, max(1, math.ceil(math.log10(high))) + 1)
    return [mantissa * 10.0**decade for decade in decades for mantissa in (1, 2, 5)]


def _number(value: float) -> str:
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e7 else f"{value:.4g}"


def _is_finite(point: tuple[float, float]) -> bool:
    return math.isfinite(point[0]) and math.isfinite(point[1])
