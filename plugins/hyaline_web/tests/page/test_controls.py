"""Tests of what mouse, keys and fingers do on the page of a trained scene."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.browser import check_accessible, wait_until
from support.web_scenes import every_surface

from benchmarks.browser import Watched, open_file, watched_page
from datagen.trace.peel import Peeler

if TYPE_CHECKING:
    from playwright.sync_api import Browser, CDPSession, Page

WRITTEN = "async () => location.hash === (await hyaline).link()"
"""The address is that of what is shown."""
STATE = "async () => { const { camera, objects } = await hyaline; return [camera.matrix, objects.all]; }"


@pytest.fixture(scope="module")
def opened(browser: "Browser", small_page: Path) -> Iterator[Watched]:
    with watched_page(browser, width=700, height=500) as page:
        open_file(page, small_page)
        yield page


@pytest.fixture
def page(opened: Watched) -> Iterator["Page"]:
    """The page as it opens, in which nothing is drawn: what is asked of it is answered at once."""
    opened.evaluate("async () => { const page = await hyaline; page.frames.held = true; page.reset(); }")
    opened.page.uncheck("#follow")
    yield opened.page
    assert opened.complaints == []


def state(page: "Page") -> tuple[np.ndarray, list[dict[str, Any]]]:
    matrix, objects = page.evaluate(STATE)
    return np.array(matrix).reshape(3, 4), objects


def center(page: "Page", selector: str) -> tuple[float, float]:
    box = page.locator(selector).bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def drag(page: "Page", start: tuple[float, float], *, right: float, down: float) -> None:
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(start[0] + right, start[1] + down, steps=3)
    page.mouse.up()


def test_a_click_chooses_the_object_under_it_and_a_drag_moves_that_over_the_ground(page: "Page") -> None:
    where = page.evaluate(
        """async () => {
            const page = await hyaline, box = page.canvas.getBoundingClientRect();
            const [x, y] = page.camera.project([0.4, -0.9, 0.25], box.width, box.height);
            return [x + box.x, y + box.y];
        }"""
    )
    page.mouse.click(*where)
    assert page.get_by_role("button", name="ice").get_attribute("aria-pressed") == "true"
    drag(page, (where[0], where[1]), right=30, down=0)
    offset = state(page)[1][6]["offset"]
    assert np.hypot(*offset[:2]) > 0.05
    assert offset[2] == 0


def test_a_link_brings_back_camera_and_edits(page: "Page") -> None:
    page.focus("#view")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("+")
    page.get_by_label("Show glass").uncheck()
    page.get_by_role("button", name="metal").click()
    page.get_by_role("button", name="Copy", exact=True).click()
    page.get_by_label("Material of").select_option("ice")
    page.get_by_label("Turn x").fill("30")
    page.get_by_role("button", name="drink").click()
    page.get_by_label("Refractive index").fill("1.7")
    wait_until(page, WRITTEN)
    link = page.url
    camera, objects = state(page)
    assert not objects[1]["shown"]
    assert objects[2]["mediumIor"] == 1.7
    assert (objects[7]["event"], objects[7]["turn"]) == ("refracts", [30, 0, 0])
    page.get_by_role("button", name="Reset").click()
    assert len(state(page)[1]) == 7
    wait_until(page, WRITTEN)
    page.goto(link)
    wait_until(page, "async () => !(await hyaline).objects.all[1].shown")
    restored = state(page)
    for one, other in zip(restored[1], objects, strict=True):
        assert one["offset"] == pytest.approx(other["offset"], abs=1e-5)
        assert {**one, "offset": 0} == {**other, "offset": 0}
    assert np.allclose(restored[0], camera, atol=1e-4)


def test_a_click_tells_the_layers_that_python_peels_and_the_branches_of_light(page: "Page") -> None:
    page.check("#follow")
    x, y = center(page, "#view")
    page.mouse.click(x, y)
    told = page.locator("#met li").all_inner_texts()
    direction = np.float32(page.evaluate("async () => (await hyaline).camera.through(1, 1, 2, 2)"))
    place = state(page)[0][:, 3].astype(np.float32)
    names = [item.name for item in every_surface().objects]
    hits = Peeler(tuple(item.mesh for item in every_surface().objects)).trace(place, direction[None], 32)
    peeled = [(names[shape], t) for shape, t in zip(hits.shape[:, 0], hits.t[:, 0], strict=True) if shape >= 0]
    layers = [re.fullmatch(r"Layer \d+: (\w+), ([\d.]+) m", line) for line in told if line.startswith("Layer")]
    assert [match[1] for match in layers if match] == [name for name, _ in peeled]
    assert [float(match[2]) for match in layers if match] == pytest.approx([t for _, t in peeled], abs=2e-3)
    branches = [line for line in told if line.startswith("Branch")]
    assert branches[0].startswith(f"Branch 1: {peeled[0][0]} → ")
    assert len(branches) > 1
    assert page.locator("#rays path").count() >= len(branches)
    assert page.locator("#rays circle").count() == len(peeled)


@pytest.mark.parametrize("is_dark", [False, True], ids=["light", "dark"])
def test_on_a_phone_the_picture_comes_first_and_the_controls_are_asked_for(
    browser: "Browser", small_page: Path, is_dark: bool
) -> None:
    with watched_page(browser, width=390, height=844, dark=is_dark) as watched:
        open_file(watched, small_page)
        page = watched.page
        box = page.locator("#stage").bounding_box()
        assert box is not None and box["height"] > 0.85 * 844
        assert page.locator("#hint").is_visible() and not page.locator("#views").is_visible()
        page.get_by_role("button", name="Controls").click()
        assert page.locator("#views").is_visible()
        check_accessible(watched)
        drag(page, center(page, "#view"), right=30, down=0)
        assert not page.locator("#hint").is_visible()
        page.locator("#busy").wait_for(state="hidden")
        assert watched.complaints == []


# Fingers: touches as the browser itself makes them, not events


Fingers = list[tuple[float, float]]
"""Where each finger is, in pixels from the middle of the picture."""


@pytest.fixture
def screen(opened: Watched) -> Iterator["CDPSession"]:
    """The same page on a screen that is opened."""
    opened.evaluate("async () => { const page = await hyaline; page.frames.held = true; page.reset(); }")
    session = opened.page.context.new_cdp_session(opened.page)
    session.send("Emulation.setTouchEmulationEnabled", {"enabled": True, "maxTouchPoints": 2})
    yield session
    session.send("Emulation.setTouchEmulationEnabled", {"enabled": False})
    session.detach()
    assert opened.complaints == []


def touch(opened: Watched, screen: "CDPSession", start: Fingers, end: Fingers, steps: int = 8) -> None:
    """Puts fingers down, moves them and lifts them."""
    box = opened.page.locator("#view").bounding_box()
    assert box is not None
    middle = np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])

    def send(kind: str, fingers: np.ndarray) -> None:
        points = [{"x": x, "y": y, "id": index} for index, (x, y) in enumerate((middle + fingers).tolist())]
        screen.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    first, last = np.array(start, float), np.array(end, float)
    send("touchStart", first)
    for share in np.linspace(0, 1, steps + 1)[1:] if start != end else []:
        send("touchMove", first + share * (last - first))
    send("touchEnd", np.empty((0, 2)))


def view_of(opened: Watched) -> tuple[np.ndarray, np.ndarray]:
    """The place of the camera, and the point that it turns about."""
    place, pivot = opened.evaluate(
        "async () => { const { camera } = await hyaline; return [camera.place, camera.pivot]; }"
    )
    return np.array(place), np.array(pivot)


def distance(state: tuple[np.ndarray, np.ndarray]) -> float:
    return float(np.linalg.norm(state[0] - state[1]))


def test_one_finger_turns_the_camera_about_what_it_looks_at(opened: Watched, screen: "CDPSession") -> None:
    before = view_of(opened)
    touch(opened, screen, [(0, 0)], [(60, 0)])
    after = view_of(opened)
    assert np.allclose(after[1], before[1])
    assert distance(after) == pytest.approx(distance(before))
    assert after[0][2] == pytest.approx(before[0][2])
    assert np.linalg.norm(after[0] - before[0]) > 0.1 * distance(before)


@pytest.mark.parametrize(("start", "end"), [(40, 80), (80, 40)], ids=["apart", "together"])
def test_two_fingers_zoom_by_as_much_as_they_part(
    opened: Watched, screen: "CDPSession", start: float, end: float
) -> None:
    before = view_of(opened)
    touch(opened, screen, [(-start, 0), (start, 0)], [(-end, 0), (end, 0)])
    after = view_of(opened)
    assert distance(after) == pytest.approx(distance(before) * start / end, rel=0.02)
    assert np.linalg.norm(after[1] - before[1]) < 0.05 * distance(before)
