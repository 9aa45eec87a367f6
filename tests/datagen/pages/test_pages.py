"""Tests of pages and their parts: nothing in them breaks out, asks for anything, or grows beyond its room."""

import base64
import io

import numpy as np
import pytest
from PIL import Image
from support.pages import read_page

from datagen.pages.charts import line_chart
from datagen.pages.html import Gallery, document, lossless_uri, section, tag

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


def test_a_picture_in_a_page_is_what_was_put_in() -> None:
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


def test_a_chart_is_a_picture_with_the_names_of_its_axes_as_they_are() -> None:
    points = [(0.5, 20.0), (10, float("inf")), (100, 25)]
    chart = line_chart(points, title="t", x_title="<one>", y_title="broken $a$")
    (picture,) = read_page(document("chart", chart)).all("img")
    assert picture.attributes["alt"] == "t"
    svg = base64.b64decode((picture.attributes["src"] or "").partition("base64,")[2]).decode()
    assert all(f">{name}</text>" in svg for name in ("&lt;one&gt;", "broken $a$"))
    assert "nothing to draw" in line_chart([], title="t", x_title="x", y_title="y")
