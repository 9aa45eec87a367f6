"""Tests the drawings in space: where they put a point, light paths that obey Snell's law, and what has no path."""

import math
import re

import numpy as np
import pytest
from support.pages import read_page
from support.synthetic import HEIGHTS, write_synthetic_dataset

from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.look.light_paths import RAYS, VIEWS, find_light_paths
from datagen.look.look import look_page
from datagen.look.turnable import AZIMUTH_DEG, ELEVATION_DEG, SIDE, Stroke, draw_turnable, path_of
from datagen.machine.mitsuba_variant import use_mitsuba

IS_SCALAR = use_mitsuba(quiet=True).startswith("scalar")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("look") / "data" / "synthetic")


def places(path: str) -> np.ndarray:
    return np.array(re.findall(r"-?[0-9.]+", path.replace("h0", "")), float).reshape(-1, 2)


def test_a_point_is_drawn_where_parallel_rays_from_the_eye_would_put_it() -> None:
    azimuth, elevation = math.radians(AZIMUTH_DEG), math.radians(ELEVATION_DEG)
    eye = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    across = np.cross([0.0, 0.0, 1.0], eye) / math.cos(elevation)
    up = np.cross(eye, across)
    points = np.random.default_rng(0).uniform(-100, 100, (20, 3))
    expected = np.stack([points @ across, -points @ up], axis=1)
    for are_dots in (False, True):
        assert np.allclose(places(path_of(points, are_dots=are_dots)), expected, atol=0.051)


def test_what_is_to_be_seen_fits_the_frame_from_every_side() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3)) + 100
    drawing = str(draw_turnable([Stroke(points=points, says="a <line>")], "thing", points))
    stored = np.array(re.findall(r'data-points="([^"]*)"', drawing)[0].split(), float).reshape(-1, 3)
    assert SIDE / 2 - 10 < np.linalg.norm(stored, axis=1).max() <= SIDE / 2 - 5
    assert "a &lt;line&gt;" in drawing


@pytest.mark.skipif(IS_SCALAR, reason="light paths need a vectorised variant of Mitsuba")
def test_a_ray_goes_straight_through_the_thin_pane_to_the_floor_and_its_mirror_image_to_the_sky(
    dataset: Dataset,
) -> None:
    paths = find_light_paths(dataset)
    assert 0 < len(paths) <= 2 * VIEWS * RAYS
    refracted, mirrored = ([path for path in paths if path.is_mirrored == which] for which in (False, True))
    assert len(refracted) == len(mirrored)
    for path in refracted:
        start, pane, *_ = path.points
        ray = (pane - start) / np.linalg.norm(pane - start)
        assert pane[2] == pytest.approx(HEIGHTS[0], abs=1e-5)
        others = path.points - start
        assert np.allclose(np.cross(others, ray), 0, atol=1e-4), "a thin pane bends nothing"
        if path.end:
            assert path.end == dataset.object_id("floor")
            assert path.points[-1][2] == pytest.approx(HEIGHTS[1], abs=1e-5)
            assert "refracted, 2 surfaces, ends on floor" in path.says
    assert any(path.end for path in refracted)
    for path in mirrored:
        start, pane, *_, end = path.points
        there, back = pane - start, end - pane
        flipped = there / np.linalg.norm(there) * [1, 1, -1]
        assert np.allclose(back / np.linalg.norm(back), flipped, atol=1e-4), "the law of reflection"
        assert path.end == 0 and path.says.endswith("ends on sky")


@pytest.mark.skipif(IS_SCALAR, reason="light paths need a vectorised variant of Mitsuba")
def test_the_page_draws_cameras_and_light_paths_in_space(dataset: Dataset) -> None:
    page = read_page(look_page(dataset))
    titles = [title.text for title in page.all("title")]
    views = sum(dataset.num_views.values())
    assert sum(title.endswith(", in space") for title in titles) == views
    assert sum("refracted" in title or "mirrored" in title for title in titles) == len(find_light_paths(dataset))
    turnable = [item for item in page.all("svg") if "turnable" in (item.attributes.get("class") or "")]
    assert [item.attributes["aria-label"] for item in turnable] == ["Cameras in space", "Light paths"]


def test_where_light_paths_cannot_be_traced_the_page_says_why_and_shows_the_rest(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: bool) -> str:
        raise HyalineError("light paths: no libLLVM; install one")

    monkeypatch.setattr("datagen.look.light_paths.use_mitsuba", refuse)
    page = read_page(look_page(dataset))
    bad = [element.text for element in page.elements if element.attributes.get("class") == "bad"]
    assert bad == ["light paths: no libLLVM; install one"]
    assert "Cameras in space" in [caption.text for caption in page.all("figcaption")]
