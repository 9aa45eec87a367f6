"""Tests of what fingers do on the page of a trained scene: touches as the browser itself makes them, not events."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from benchmarks.browser import Watched, open_file, watched_page

if TYPE_CHECKING:
    from playwright.sync_api import Browser, CDPSession

Fingers = list[tuple[float, float]]
"""Where each finger is, in pixels from the middle of the picture."""


BESIDE = [(right, down) for right in (-40, 40, -25, 25) for down in (-40, -20, 20, 40)]
"""Places where the handles of what stands in the middle may leave room."""


@pytest.fixture(scope="module")
def opened(browser: "Browser", small_page: Path) -> Iterator[Watched]:
    """A page on a screen that is touched, in which nothing is drawn."""
    with watched_page(browser, width=390, height=700) as page:
        open_file(page, small_page)
        page.evaluate("async () => { (await hyaline).frames.held = true; }")
        yield page


@pytest.fixture
def screen(opened: Watched) -> Iterator["CDPSession"]:
    opened.evaluate("async () => { (await hyaline).reset(); }")
    session = opened.page.context.new_cdp_session(opened.page)
    session.send("Emulation.setTouchEmulationEnabled", {"enabled": True, "maxTouchPoints": 2})
    yield session
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


def camera(opened: Watched) -> tuple[np.ndarray, np.ndarray]:
    """The place of the camera, and the point that it turns about."""
    place, pivot = opened.evaluate(
        "async () => { const { camera } = await hyaline; return [camera.place, camera.pivot]; }"
    )
    return np.array(place), np.array(pivot)


def under(opened: Watched, place: tuple[float, float]) -> int | None:
    """The object that is seen at a place of the picture; None where a handle lies over it, or none is seen."""
    found = opened.evaluate(
        """async ([right, down]) => {
            const { tracer, camera, canvas } = await hyaline, box = canvas.getBoundingClientRect();
            const at = [box.width / 2 + right, box.height / 2 + down];
            if (document.elementFromPoint(box.left + at[0], box.top + at[1]) !== canvas) return null;
            return tracer.pick(camera, ...at, box.width, box.height);
        }""",
        list(place),
    )
    return found and found["object"]


def distance(state: tuple[np.ndarray, np.ndarray]) -> float:
    return float(np.linalg.norm(state[0] - state[1]))


def test_one_finger_turns_the_camera_about_what_it_looks_at(opened: Watched, screen: "CDPSession") -> None:
    before = camera(opened)
    touch(opened, screen, [(0, 0)], [(60, 0)])
    after = camera(opened)
    assert np.allclose(after[1], before[1])
    assert distance(after) == pytest.approx(distance(before))
    assert after[0][2] == pytest.approx(before[0][2])
    assert np.linalg.norm(after[0] - before[0]) > 0.1 * distance(before)


def test_two_fingers_side_by_side_shift_the_scene_and_zoom_little(opened: Watched, screen: "CDPSession") -> None:
    before = camera(opened)
    touch(opened, screen, [(-50, 0), (50, 0)], [(-50, 60), (50, 60)])
    after = camera(opened)
    shift = after[1] - before[1]
    assert np.linalg.norm(shift) > 0.05 * distance(before)
    assert shift[2] > 0  # The fingers take the scene down with them, so the camera rises.
    assert distance(after) == pytest.approx(distance(before), rel=0.02)


@pytest.mark.parametrize(("start", "end"), [(40, 80), (80, 40)], ids=["apart", "together"])
def test_two_fingers_zoom_by_as_much_as_they_part(
    opened: Watched, screen: "CDPSession", start: float, end: float
) -> None:
    before = camera(opened)
    touch(opened, screen, [(-start, 0), (start, 0)], [(-end, 0), (end, 0)])
    after = camera(opened)
    assert distance(after) == pytest.approx(distance(before) * start / end, rel=0.02)
    assert np.linalg.norm(after[1] - before[1]) < 0.05 * distance(before)


def test_a_tap_chooses_what_is_under_it_and_turns_nothing(opened: Watched, screen: "CDPSession") -> None:
    before, aimed_at = camera(opened), under(opened, (0, 0))
    assert aimed_at is not None
    touch(opened, screen, [(0, 0)], [(0, 0)])
    assert opened.evaluate("async () => (await hyaline).chosen") == aimed_at
    assert np.allclose(camera(opened)[0], before[0])


def test_a_tap_of_two_fingers_chooses_nothing_and_asks_for_nothing(opened: Watched, screen: "CDPSession") -> None:
    opened.evaluate(
        "async () => { const page = await hyaline; page.heard = []; page.clicked = (at) => page.heard.push(at); }"
    )
    try:
        touch(opened, screen, [(-20, 0), (20, 0)], [(-20, 0), (20, 0)])
        assert opened.evaluate("async () => (await hyaline).heard") == []
        touch(opened, screen, [(0, 0)], [(0, 0)])
        assert opened.evaluate("async () => (await hyaline).heard") == [under(opened, (0, 0))]
    finally:
        opened.evaluate("async () => { delete (await hyaline).clicked; }")


def test_one_finger_drags_the_chosen_object_over_the_ground(opened: Watched, screen: "CDPSession") -> None:
    chosen = under(opened, (0, 0))
    touch(opened, screen, [(0, 0)], [(0, 0)])
    before = camera(opened)
    beside = next(place for place in BESIDE if under(opened, place) == chosen)
    touch(opened, screen, [beside], [(beside[0] + 40, beside[1])])
    offset = opened.evaluate("async (index) => (await hyaline).objects.all[index].offset", chosen)
    assert np.linalg.norm(offset[:2]) > 0.05
    assert offset[2] == pytest.approx(0, abs=1e-6)
    assert np.allclose(camera(opened)[0], before[0])
