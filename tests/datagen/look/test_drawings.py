"""Tests the drawings of a scene: what hides what, where lines go, and light paths that obey the laws of optics."""

import re
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.pages import Element, ReadPage, read_page
from support.synthetic import HEIGHTS, quad, write_synthetic_dataset

from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.look.light_paths import RAYS, _projected, find_light_paths
from datagen.look.sketch import INK, MARGIN, MOST_CAMERAS, PALE_INK, draw_cameras, draw_sketch, fit_viewpoint, rasterise
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


@pytest.mark.parametrize("seed", range(3))
def test_each_pixel_shows_the_nearest_face_at_its_centre(seed: int) -> None:
    generator = np.random.default_rng(seed)
    faces = generator.uniform(-6, 30, (12, 3, 3))
    least = np.full((20, 24), 4, np.float32)
    depth, face, weights = rasterise(faces, least)
    for row in range(20):
        for column in range(24):
            found = []
            for number, corners in enumerate(faces):
                system = np.vstack([corners[:, :2].T, np.ones(3)])
                shares = np.linalg.solve(system, [column + 0.5, row + 0.5, 1])
                if shares.min() >= 0 and shares @ corners[:, 2] > 4:
                    found.append((shares @ corners[:, 2], number, shares))
            nearest = min(found, key=lambda item: item[0], default=None)
            assert face[row, column] == (-1 if nearest is None else nearest[1])
            if nearest is not None:
                assert depth[row, column] == pytest.approx(nearest[0], abs=1e-4)
                np.testing.assert_allclose(weights[row, column], nearest[2], atol=1e-5)


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(0, 0), (-50, 30), (170, 90), (20, -40)])
def test_what_is_to_be_seen_fits_the_frame_from_every_side(azimuth_deg: float, elevation_deg: float) -> None:
    points = np.random.default_rng(1).normal(size=(50, 3)) + 100
    placed = fit_viewpoint(points, azimuth_deg, elevation_deg, width=300, height=200).place(points)
    low, high = placed[:, :2].min(axis=0), placed[:, :2].max(axis=0)
    assert (low >= MARGIN - 1e-6).all() and (high <= np.array([300, 200]) - MARGIN + 1e-6).all()
    assert ((high - low) / (np.array([300, 200]) - 2 * MARGIN)).max() == pytest.approx(1)


def test_what_is_nearer_hides_lines_behind_it_and_glass_hides_nothing() -> None:
    meshes = (quad(0.0), quad(-1.0))
    place = fit_viewpoint(np.array([[-2.0, -2, -2], [2, 2, 2]]), 0, 60, width=400, height=400)
    line = np.array([[0.0, -3, -0.5], [0, 3, -0.5]])  # Between the two: hidden where it runs under the upper one.
    for is_glass, parts in ((np.array([False, False]), 2), (np.array([True, False]), 1)):
        sketch = draw_sketch(meshes, is_glass, place)
        drawn = str(sketch.stroke(line, label="a <line>", class_="ray"))
        assert "a &lt;line&gt;" in drawn
        assert drawn.count('class="hidden"') == parts - 1
        inks = {tuple(pixel) for pixel in sketch.picture[..., :3].reshape(-1, 3)}
        assert INK in inks and (PALE_INK in inks) == (parts == 2), "edges under the upper square are paler"
    hidden = re.findall(r"-?[0-9.]+", re.findall(r'd="([^"]*)" class="hidden"', str(_opaque(meshes, place, line)))[0])
    across = np.array(hidden, float).reshape(-1, 2)[:, 0]
    right = place.place(np.array([[0.0, -1, 0], [0.0, 1, 0]]))[:, 0]
    assert (across.min(), across.max()) == pytest.approx((right.min(), right.max()), abs=5)


def _opaque(meshes, place, line) -> str:
    return draw_sketch(meshes, np.array([False, False]), place).stroke(line, label="", class_="")


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


def test_the_page_draws_light_paths_over_the_picture_and_in_the_scene(page: ReadPage, dataset: Dataset) -> None:
    found = find_light_paths(dataset)
    assert found is not None
    name = f"train view {found.view}"
    drawings = [item.attributes["aria-label"] for item in page.all("svg") if _has_class(item, "drawing")]
    assert drawings[:2] == [f"Light paths over {name}", f"Light paths of {name} in the scene"]
    # Each kind has a line, a mark and words of its own: nothing is told by colour alone.
    for kind, mark in (("refracted", "disc"), ("reflected", "diamond")):
        assert any(item.text.startswith(f"{kind}: ") and mark in item.text for item in page.all("li"))
        assert any(title.text.startswith(f"ray 1, {kind}: hits pane") for title in page.all("title"))
    assert re.search(r"\.reflected path[^{]*{ stroke-dasharray", page.source)
    rings = [item for item in page.all("circle") if item.attributes.get("class") == "ring"][:RAYS]
    centres = {(float(ring.attributes["cx"] or ""), float(ring.attributes["cy"] or "")) for ring in rings}
    assert centres == {(path.pixel[0] + 0.5, path.pixel[1] + 0.5) for path in found.paths}
    assert "camera" in [text.text for text in page.all("text")]
    rows = [row.text for row in page.all("tr")]
    for path in found.paths:
        assert any(row.startswith(f"{path.ray}{path.pixel[0]}, {path.pixel[1]}pane → ") for row in rows)


def test_without_its_picture_a_view_s_paths_are_drawn_in_the_scene(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic")
    found = find_light_paths(dataset)
    assert found is not None
    (dataset.root / "images" / "train" / f"{found.view:04d}.png").unlink()
    run(f"datagen look '{dataset.root}' --out '{tmp_path}/look.html'")
    page = read_page((tmp_path / "look.html").read_bytes())
    labels = [item.attributes.get("aria-label") for item in page.all("svg")]
    assert f"Light paths of train view {found.view} in the scene" in labels
    assert f"Light paths over train view {found.view}" not in labels
    bad = [item.text for item in page.all("p") if item.attributes.get("class") == "bad"]
    assert any(f"train/{found.view:04d}.png" in text for text in bad)


def test_the_page_draws_every_camera_and_tells_splits_apart(page: ReadPage, dataset: Dataset) -> None:
    titles = [title.text for title in page.all("title")]
    for split, count in dataset.num_views.items():
        for view in range(count):
            assert titles.count(f"{split} view {view}") >= 3, "in front, from above and from the side"
        assert f"{split}: {count:,} cameras" in [item.text for item in page.all("li")]
    drawings = [item.attributes["aria-label"] for item in page.all("svg") if _has_class(item, "drawing")]
    assert drawings[-3:] == ["Cameras from in front", "Cameras from above", "Cameras from the side"]
    keys = re.findall(r'<svg class="key stroke s\d".*?</svg>', page.source)
    assert len({re.sub(r"s\d", "", key) for key in keys}) == len(dataset.splits), "by more than colour"


def test_of_very_many_cameras_a_selection_is_drawn(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    count = dataset.num_views["train"]
    assert count < MOST_CAMERAS
    monkeypatch.setattr("datagen.look.sketch.MOST_CAMERAS", 2)
    drawn = str(draw_cameras(dataset))
    assert f"train: 2 of {count} cameras" in drawn
    assert len(set(re.findall(r"<title>(train view \d+)", drawn))) == 2


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
    assert "Cameras from in front" in [caption.text for caption in page.all("figcaption")]


def _has_class(element: Element, name: str) -> bool:
    return name in (element.attributes.get("class") or "").split()
