"""Tests of pages in a real browser: they sort, slide and switch, fit a phone, and ask for nothing."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.browser import check_accessible, require_browser
from support.synthetic import write_predictions, write_synthetic_dataset

from benchmarks.browser import Watched, running_browser, watched_page
from datagen.data.dataset import Dataset
from datagen.look.look import look_page
from eval.page.report import make_report

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    require_browser()
    return write_synthetic_dataset(tmp_path_factory.mktemp("browser") / "data" / "synthetic")


@pytest.fixture(scope="module")
def report(dataset: Dataset) -> Path:
    """The page of two runs, one much darker than the truth."""
    root = dataset.root.parents[1]
    for name, step in (("near", 3), ("very dark", 200)):
        write_predictions(dataset, root / "runs/synthetic" / name, lambda image, by=step: image - np.minimum(image, by))
    make_report(root / "runs", root / "data", root / "out", output_format="json")
    return root / "out" / "index.html"


@pytest.fixture(scope="module")
def browser(dataset: Dataset) -> Iterator["Browser"]:
    with running_browser() as running:
        yield running


@pytest.fixture
def shown(browser: "Browser", report: Path) -> Iterator[Watched]:
    """The report, which has asked for nothing and complained of nothing when the test is over."""
    with watched_page(browser, width=1100, height=800) as watched:
        watched.page.goto(report.as_uri())
        yield watched
        assert watched.complaints == []
        assert {request.partition("#")[0] for request in watched.requests} == {report.as_uri()}


def test_tables_sort_by_mouse_and_keyboard_and_say_so(shown: Watched) -> None:
    page = shown.page
    table = page.locator("table").first
    names = table.locator("tbody th")
    head = table.locator("thead th").nth(2)
    assert names.all_inner_texts() == ["near", "very dark"]
    head.locator("button").click()
    assert (head.get_attribute("aria-sort"), names.all_inner_texts()) == ("descending", ["near", "very dark"])
    page.keyboard.press("Enter")
    assert (head.get_attribute("aria-sort"), names.all_inner_texts()) == ("ascending", ["very dark", "near"])
    assert table.locator("thead th").nth(3).get_attribute("aria-sort") == "none"
    assert "ceiling" in table.locator("tfoot").inner_text()


def test_one_part_is_shown_at_a_time_and_the_slider_parts_truth_and_prediction(shown: Watched) -> None:
    page = shown.page
    page.locator("nav").get_by_text("very dark").click()
    view = page.locator(".view:visible", has_text="(worst)").first
    view.wait_for()  # The page changes a moment after the click.
    assert page.locator("main > .page:visible").count() == 1
    slider, pictures = view.locator("input[type=range]"), view.locator(".row")
    boxes = [picture.bounding_box() for picture in view.locator(".picture:visible").all()]
    assert [box is not None and box["width"] >= 256 for box in boxes] == [True] * 3  # Truth, prediction and error.
    assert view.locator(".sharp:visible").count() == 3
    view.get_by_role("button", name="slider").click()

    def brightness(value: int) -> float:
        slider.evaluate("(slider, value) => { slider.value = value; slider.dispatchEvent(new Event('input')); }", value)
        return mean_of(pictures.screenshot())

    truth, half, prediction = brightness(100), brightness(50), brightness(0)
    assert truth > half + 10 > prediction + 20
    slider.focus()
    page.keyboard.press("ArrowRight")
    assert slider.input_value() == "1"
    view.get_by_role("button", name="very dark").click()
    assert view.locator(".picture:visible").count() == 2
    assert mean_of(view.locator(".error").screenshot()) > 150  # Eight times a large difference: white.


@pytest.mark.parametrize("is_dark", [False, True], ids=["light", "dark"])
def test_neither_page_is_wider_than_a_phone(browser: "Browser", report: Path, dataset: Dataset, is_dark: bool) -> None:
    look = dataset.root.parents[1] / "look.html"
    look.write_bytes(look_page(dataset))
    for path in (report, look):
        with watched_page(browser, width=390, height=800, dark=is_dark) as watched:
            watched.page.goto(path.as_uri())
            assert (mean_of(watched.page.screenshot()) < 128) == is_dark
            for link in watched.page.locator("nav a").all():
                link.click()
                assert watched.evaluate("() => document.documentElement.scrollWidth") <= 390
            check_accessible(watched)
            assert watched.complaints == []


def mean_of(png: bytes) -> float:
    import io

    from PIL import Image

    with Image.open(io.BytesIO(png)) as picture:
        return float(np.mean(np.asarray(picture.convert("RGB"))))
