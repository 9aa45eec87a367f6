"""What tests of pages share: a browser, the scene of every surface, and its page."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support.browser import require_browser

from benchmarks.browser import Watched, running_browser
from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from datagen.machine.mitsuba_variant import use_mitsuba

use_mitsuba()  # What traces light paths can be imported only when Mitsuba has its variant.

from support.web_scenes import STILL, every_surface, noisy_light_path, opened_page, write_scene  # noqa: E402

from hyaline_web.page.export import scene_page  # noqa: E402
from model.methods.light_path.net import LightPathRenderer  # noqa: E402

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The scene with its cameras, without any picture."""
    return write_scene(tmp_path_factory.mktemp("web") / "data" / "web", every_surface())


@pytest.fixture(scope="session")
def renderer() -> LightPathRenderer:
    return noisy_light_path()


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    require_browser()
    with running_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def small_page(renderer: LightPathRenderer, dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of the page that keeps few bits of each number."""
    file = tmp_path_factory.mktemp("page") / "small.html"
    file.write_bytes(scene_page(renderer, renderer.config, dataset, TRUTH, "small", label="noise", still=STILL))
    return file


@pytest.fixture(scope="module")
def page(
    browser: "Browser", renderer: LightPathRenderer, dataset: Dataset, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Watched]:
    """The page that keeps every number as it is, opened."""
    with opened_page(browser, tmp_path_factory.mktemp("page"), renderer, dataset) as page:
        yield page
