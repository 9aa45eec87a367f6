"""Tests that Firefox draws the page as Python does."""

from pathlib import Path

from support.browser import require
from support.firefox import find_firefox, running_firefox
from support.web_scenes import SHAPE, STILL, VIEW, drawn_by_python, psnr

from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from model.methods.light_path.net import LightPathRenderer
from model.web.export import scene_page


def test_firefox_draws_what_python_draws(renderer: LightPathRenderer, dataset: Dataset, tmp_path: Path) -> None:
    require(find_firefox)
    file = tmp_path / "page.html"
    file.write_bytes(scene_page(renderer, renderer.config, dataset, TRUTH, "exact", label="noise", still=STILL))
    with running_firefox() as firefox:
        firefox.open_file(file)
        drawn = firefox.picture(VIEW, SHAPE, 1)
    assert psnr(drawn, drawn_by_python(renderer, dataset)) >= 45
