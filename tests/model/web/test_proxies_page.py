"""Tests that the page of `light-path` on proxies (shells, straight layers, relief) draws what Python draws."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from support.web_scenes import SHAPE, STILL, VIEW, drawn_by_python, noisy_light_path, psnr, solid_surfaces, write_scene

from benchmarks.browser import open_file, watched_page
from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from model.web.export import scene_page

if TYPE_CHECKING:
    from playwright.sync_api import Browser

PROXY = {"straight_layers": 7, "shells": 3, "relief": "on", "directions": "on", "stack_hidden": 12}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_scene(tmp_path_factory.mktemp("proxies") / "data" / "web", solid_surfaces())


@pytest.mark.parametrize(
    ("change", "quality", "least"),
    [
        (PROXY, "exact", 45),
        (PROXY, "small", 42),
        ({**PROXY, "compositing": "stack", "position_octaves": 1}, "exact", 45),
    ],
    ids=["exact", "small", "stacked alone"],
)
def test_straight_layers_shells_and_relief_are_drawn_as_by_python(
    browser: "Browser", dataset: Dataset, tmp_path: Path, change: dict[str, Any], quality: Any, least: float
) -> None:
    renderer = noisy_light_path(**change)
    file = tmp_path / "page.html"
    file.write_bytes(scene_page(renderer, renderer.config, dataset, TRUTH, quality, label="noise", still=STILL))
    truth = drawn_by_python(renderer, dataset)
    assert truth.std() > 15
    with watched_page(browser) as page:
        open_file(page, file)
        assert psnr(page.picture(VIEW, SHAPE, 1), truth) >= least
        assert page.complaints == []
