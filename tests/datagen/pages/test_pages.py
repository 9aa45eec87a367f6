"""Tests of pages and their parts: nothing in them breaks out, asks for anything, or grows beyond its room."""

import re

import numpy as np
import pytest
from support.pages import read_page

from datagen.pages.charts import COLORS, GRID, HEIGHT, SOFT, WIDTH, Line, line_chart
from datagen.pages.html import Markup, document, join, prose, read_part, section, tag
from datagen.pages.pictures import Gallery, lossless_uri

HOSTILE = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "' onmouseover='alert(1)",
    "</style><b>",
    "a & b < c",
    "\x1b[31mred\x00\nline\u202e",
    "]]><!--",
    "&#60;script&#62;",
)


@pytest.mark.parametrize("text", HOSTILE)
def test_what_a_page_shows_is_never_markup(text: str) -> None:
    data = document(text, section(text, tag("p", text, title=text), id_="here"))
    page = read_page(data)
    (paragraph,) = page.all("p")
    shown = paragraph.text
    assert shown == paragraph.attributes["title"] == page.all("title")[0].text
    assert shown.isprintable() and (shown == text or not text.isprintable())
    assert [element.name for element in page.elements].count("script") == 1
    assert not page.all("b") and not page.all("img")


def test_markup_is_not_escaped_twice_and_absent_parts_leave_no_trace() -> None:
    inner = tag("b", "1 < 2")
    assert join([inner, None, 3]) == "<b>1 &lt; 2</b>3"
    assert tag("a", inner, None, href=None, hidden=True, disabled=False, class_="x") == (
        '<a hidden class="x"><b>1 &lt; 2</b></a>'
    )
    assert isinstance(tag("p", "x"), Markup)


def test_a_picture_in_a_page_is_what_was_put_in() -> None:
    import base64
    import io

    from PIL import Image

    image = np.random.default_rng(0).integers(0, 256, (9, 7, 3), np.uint8)
    kind, content = lossless_uri(image).split(",")
    assert kind == "data:image/webp;base64"
    with Image.open(io.BytesIO(base64.b64decode(content))) as stored:
        np.testing.assert_array_equal(np.asarray(stored.convert("RGB")), image)


def test_a_gallery_keeps_each_picture_once_and_below_its_room() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (3, 32, 32, 3), np.uint8)
    room = len(lossless_uri(noise[0])) + len(lossless_uri(noise[1]))
    gallery = Gallery(room)
    asked = []

    def add(name: str, place: int) -> bool:
        return gallery.add(name, lambda: asked.append(name) or noise[place])

    assert [add("a", 0), add("b", 1), add("a", 0), add("c", 2), add("d", 2), add("c", 2)] == [True] * 3 + [False] * 3
    assert asked == ["a", "b", "c"]  # Where one found no room, later ones are not even read.
    assert gallery.left_out == 2
    store, shown = gallery.store(), gallery.show("a", "b", label="a over b", class_="error")
    assert store.count("data:image/webp") == 2
    assert len(store) < room + 500
    page = read_page(document("pictures", store, shown))
    assert [use.attributes["href"] for use in page.all("use")] == ["#a", "#b"]


def test_of_many_lines_in_a_chart_no_two_look_alike() -> None:
    lines = tuple(Line(name=str(place), points=((0, place), (1, place))) for place in range(30))
    page = read_page(document("chart", line_chart(lines, title="t", x_title="x", y_title="y")))
    styles = [item.attributes["class"] for item in page.all("li")]
    assert len(set(styles)) == 30
    drawn = [path.attributes for path in page.all("path") if (path.attributes["d"] or "").count("L") == 1]
    looks = [(path["stroke"], path.get("stroke-dasharray")) for path in drawn if path["stroke"] != "var(--line)"]
    assert len(set(looks)) == len(looks) == 30
    assert [look[0] for look in looks] == [f"var(--{(style or '')[:2]})" for style in styles]


def test_no_tick_of_a_chart_is_cut_off_at_any_size_of_its_text() -> None:
    line = Line(name="loss", points=((0, 0.00012), (250_000, 0.0005)))
    page = read_page(document("chart", line_chart((line,), title="t", x_title="step", y_title="loss")))
    (phone,) = map(int, re.findall(r"\.chart text { font-size: (\d+)px; }", page.source))
    ticks = [text for text in page.all("text") if re.fullmatch(r"[-0-9.,e]+", text.text)]
    assert "200000" in [text.text for text in ticks]
    for text in ticks:
        x, width = float(text.attributes["x"] or ""), 0.6 * phone * len(text.text)
        before = width if text.attributes["text-anchor"] == "end" else width / 2
        after = 0 if text.attributes["text-anchor"] == "end" else width / 2
        assert x - before >= 0 and x + after <= WIDTH


def test_colours_meet_wcag_aa_in_both_themes() -> None:
    """4.5 : 1 for text and 3 : 1 for marks; marks are never the colour of text."""
    style = read_part("page.css")
    assert re.search(r"\.legend span { color: var\(--ink\); }", style)
    light, dark = (
        {**dict(re.findall(r"--(\w+): (#\w+)", block))} for block in re.findall(r":root {(.*?)}", style, re.S)
    )
    assert light.keys() - dark.keys() == set() and len(light) == 16
    for colors in (light, dark):
        for text in ("ink", "soft", "accent", "best", "bad"):
            for below in ("paper", "panel"):
                assert contrast(colors[text], colors[below]) >= 4.5, (text, below)
        for mark in (f"s{place}" for place in range(8)):
            assert contrast(colors[mark], colors["paper"]) >= 3, mark


def contrast(one: str, other: str) -> float:
    """Source: WCAG 2.2, relative luminance and contrast ratio."""

    def luminance(color: str) -> float:
        digits = color[1:] if len(color) == 7 else "".join(2 * digit for digit in color[1:])
        channels = np.frombuffer(bytes.fromhex(digits), np.uint8) / 255
        linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_what_stands_between_backticks_is_code_and_a_lone_one_stays() -> None:
    assert prose("run `a < b` now") == "run <code>a &lt; b</code> now"
    assert prose("a ` alone") == "a ` alone"


def test_a_chart_stands_within_its_frame_in_the_colours_of_the_page() -> None:
    lines = (
        Line(name="<one>", points=((0.5, 20.0), (10, 30.5), (100, 25))),
        Line(name="broken $a$", points=((1, 21), (2, float("inf")), (3, 22))),
        Line(name="empty", points=()),
    )
    page = read_page(document("chart", line_chart(lines, title="t", x_title="x", y_title="y")))
    paths = [path for path in page.all("path") if path.attributes.get("stroke") not in (None, "var(--line)")]
    colors = {path.attributes[name] for path in paths for name in ("stroke", "fill") if name in path.attributes}
    assert colors == {"var(--s0)", "var(--s1)", "none"}
    dots = [path.attributes["transform"] or "" for path in paths if path.attributes.get("transform")]
    assert len(dots) == 5  # An infinite value parts a line.
    for dot in dots:
        x, y = map(float, dot.removeprefix("translate(").removesuffix(")").split())
        assert 0 <= x <= WIDTH and 0 <= y <= HEIGHT
    assert [item.text for item in page.all("li")] == ["<one>", "broken $a$"]
    assert "nothing to draw" in line_chart(lines[2:], title="t", x_title="x", y_title="y")


def test_the_colours_of_charts_are_those_of_the_light_theme() -> None:
    light = dict(re.findall(r"--(\w+): (#\w+)", read_part("page.css").partition("@media")[0]))
    assert [light[f"s{place}"] for place in range(8)] == list(COLORS)
    assert (light["soft"], light["line"]) == (SOFT, GRID)
