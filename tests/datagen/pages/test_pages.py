"""Tests of pages and their parts: nothing in them breaks out, asks for anything, or grows beyond its room."""

import base64
import re

import numpy as np
import pytest
from support.pages import read_page

from datagen.pages.charts import COLORS, GRID, SOFT, Line, line_chart
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


def test_the_colours_of_charts_are_those_of_the_light_theme() -> None:
    light = dict(re.findall(r"--(\w+): (#\w+)", read_part("page.css").partition("@media")[0]))
    assert [light[f"s{place}"] for place in range(8)] == list(COLORS)
    assert (light["soft"], light["line"]) == (SOFT, GRID)


def test_a_chart_is_a_picture_with_the_names_of_its_lines_as_they_are() -> None:
    lines = (
        Line(name="<one>", points=((0.5, 20.0), (10, 30.5), (100, 25))),
        Line(name="broken $a$", points=((1, 21), (2, float("inf")), (3, 22))),
    )
    chart = line_chart(lines, title="t", x_title="x", y_title="y")
    (picture,) = read_page(document("chart", chart)).all("img")
    assert picture.attributes["alt"] == "t"
    svg = base64.b64decode((picture.attributes["src"] or "").partition("base64,")[2]).decode()
    assert all(f">{name}</text>" in svg for name in ("&lt;one&gt;", "broken $a$"))
    assert "nothing to draw" in line_chart((Line(name="empty", points=()),), title="t", x_title="x", y_title="y")
