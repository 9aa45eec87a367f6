"""Tests the drawings of a page: the plan of the cameras, and light paths that obey the laws of optics."""

import re
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.pages import Element, ReadPage, read_page
from support.synthetic import HEIGHTS, write_synthetic_dataset

from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.look.cameras import draw_cameras
from datagen.look.light_paths import RAYS, _projected, find_light_paths
from datagen.machine.mitsuba_variant import use_mitsuba

use_mitsuba()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("look") / "data" / "synthetic")


@pytest.fixture(scope="module")
def page(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> ReadPage:
    """What the command writes."""
    path = tmp_path_factory.mktemp("page") / "look.html"
    run(f"datagen look '{dataset.root}' --out '{path}'")
    return read_page(path.read_bytes())


def test_a_ray_goes_straight_through_the_thin_pane_to_the_floor_and_its_mirror_image_to_the_sky(
    dataset: Dataset,
) -> None:
    found = find_light_paths(dataset)
    assert found is not None
    assert {path.ray for path in found.paths} == set(range(1, RAYS + 1))
    origin, directions = found.camera.rays()
    for path in found.paths:
        column, row = path.pixel
        camera, pane, *_, end = path.points
        np.testing.assert_array_equal(camera, origin)
        ray = (pane - camera) / np.linalg.norm(pane - camera)
        assert np.allclose(ray, directions[row, column], atol=1e-5), "it begins at the camera, through its pixel"
        assert pane[2] == pytest.approx(HEIGHTS[0], abs=1e-5)
        if path.is_reflected:
            back = end - pane
            assert np.allclose(back / np.linalg.norm(back), ray * [1, 1, -1], atol=1e-4), "the law of reflection"
            assert (path.end, path.through) == (0, "pane")
        else:
            assert np.allclose(np.cross(end - pane, ray), 0, atol=1e-4), "a thin pane bends nothing"
            assert path.through == "pane"
            if path.end:
                assert path.end == dataset.object_id("floor")
                assert end[2] == pytest.approx(HEIGHTS[1], abs=1e-5)
    kinds = [path.is_reflected for path in found.paths]
    assert kinds.count(True) == kinds.count(False) == RAYS
    assert any(path.end for path in found.paths)


def test_a_path_in_the_picture_begins_at_its_pixel_and_ends_where_it_leaves_the_picture(dataset: Dataset) -> None:
    camera = dataset.cameras("train")[0]
    origin, directions = camera.rays()
    first = origin + 2.0 * directions[5, 9].astype(np.float64)
    inside = origin + 3.0 * directions[20, 16].astype(np.float64)
    behind = origin - 2.0 * directions[5, 9].astype(np.float64)
    places, stays = _projected(camera, np.array([first, inside]))
    assert stays and np.allclose(places, [[9.5, 5.5], [16.5, 20.5]], atol=1e-3)
    places, stays = _projected(camera, np.array([first, inside, behind, inside]))
    assert not stays and len(places) == 3
    assert (places >= 0).all() and (places <= [camera.width, camera.height]).all()


def test_the_page_draws_light_paths_over_the_picture(page: ReadPage, dataset: Dataset) -> None:
    found = find_light_paths(dataset)
    assert found is not None
    name = f"train view {found.view}"
    drawings = [item.attributes["aria-label"] for item in page.all("svg") if _has_class(item, "drawing")]
    assert drawings == [f"Light paths over {name}", "Cameras from above"]
    # Each kind has a line, a mark and words of its own: nothing is told by colour alone.
    for kind, mark in (("refracted", "disc"), ("reflected", "diamond")):
        assert any(item.text.startswith(f"{kind}: ") and mark in item.text for item in page.all("li"))
    assert re.search(r"\.reflected path[^{]*{ stroke-dasharray", page.source)
    rings = [item for item in page.all("circle") if item.attributes.get("class") == "ring"][:RAYS]
    centres = {(float(ring.attributes["cx"] or ""), float(ring.attributes["cy"] or "")) for ring in rings}
    assert centres == {(path.pixel[0] + 0.5, path.pixel[1] + 0.5) for path in found.paths}
    rows = [row.text for row in page.all("tr")]
    for path in found.paths:
        assert any(row.startswith(f"{path.ray}{path.pixel[0]}, {path.pixel[1]}pane → ") for row in rows)


def test_the_plan_shows_every_camera_and_tells_splits_apart(
    page: ReadPage, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    titles = [title.text for title in page.all("title")]
    for split, count in dataset.num_views.items():
        assert {f"{split} view {view}" for view in range(count)} <= set(titles)
        assert f"{split}: {count:,} cameras" in [item.text for item in page.all("li")]
    assert "pane" in titles
    keys = re.findall(r'<svg class="key stroke s\d".*?</svg>', page.source)
    assert len({re.sub(r"s\d", "", key) for key in keys}) == len(dataset.splits), "by more than colour"
    monkeypatch.setattr("datagen.look.cameras.MOST_CAMERAS", 2)
    drawn = str(draw_cameras(dataset))
    assert f"train: 2 of {dataset.num_views['train']} cameras" in drawn
    assert len(set(re.findall(r"<title>(train view \d+)", drawn))) == 2


def test_without_its_picture_a_view_s_paths_are_its_error(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic")
    found = find_light_paths(dataset)
    assert found is not None
    (dataset.root / "images" / "train" / f"{found.view:04d}.png").unlink()
    run(f"datagen look '{dataset.root}' --out '{tmp_path}/look.html'")
    page = read_page((tmp_path / "look.html").read_bytes())
    bad = [item.text for item in page.all("p") if item.attributes.get("class") == "bad"]
    assert any(f"train/{found.view:04d}.png" in text for text in bad)


def test_where_light_paths_cannot_be_traced_the_page_says_why_and_shows_the_rest(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: bool) -> str:
        raise HyalineError("light paths: no libLLVM; `datagen doctor` names it")

    monkeypatch.setattr("datagen.look.light_paths.use_mitsuba", refuse)
    run(f"datagen look '{dataset.root}' --out '{tmp_path}/look.html'")
    page = read_page((tmp_path / "look.html").read_bytes())
    bad = [element.text for element in page.elements if element.attributes.get("class") == "bad"]
    assert bad == ["light paths: no libLLVM; datagen doctor names it"]
    assert "Cameras from above, and the glass" in [caption.text for caption in page.all("figcaption")]


def _has_class(element: Element, name: str) -> bool:
    return name in (element.attributes.get("class") or "").split()
