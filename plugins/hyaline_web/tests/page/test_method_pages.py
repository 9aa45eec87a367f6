"""Tests that a distribution of somebody else's brings a page for its own method: the example of the documentation."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image
from support.commands import call
from support.synthetic import write_synthetic_dataset
from support.web_scenes import psnr

from benchmarks.browser import open_file, watched_page

if TYPE_CHECKING:
    from playwright.sync_api import Browser

GUIDE = Path(__file__).parents[4] / "docs" / "adding-a-web-page.md"


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The guide's module with its entry point, where this process finds them."""
    guide = GUIDE.read_text()
    module = re.search(r"```python\n(.*?)```", guide, re.DOTALL)
    point = re.search(r'`(first-surface = )"(.*?)"`', guide)
    assert module is not None and point is not None
    place = tmp_path / "installed"
    metadata = place / "first_surface-1.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: first-surface\nVersion: 1\n")
    (metadata / "entry_points.txt").write_text(f"[hyaline.methods]\n{point[1]}{point[2]}\n")
    (place / "first_surface.py").write_text(module[1])
    monkeypatch.syspath_prepend(place)
    yield
    sys.modules.pop("first_surface", None)


@pytest.mark.usefixtures("installed")
def test_the_page_of_the_guides_method_draws_what_its_run_predicts(browser: "Browser", tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data")
    run, page = tmp_path / "run", tmp_path / "page.html"
    trained = call(f"model train first-surface --dataset {dataset.root} --out {run} --steps 100 --batch 256 --lr 0.05")
    assert trained.status == 0, trained.err
    assert call(f"model export {run} --out {page} --quality exact").status == 0
    predicted = np.asarray(Image.open(run / "predictions" / "interpolating" / "0000.png"))
    assert predicted.std() > 10
    with watched_page(browser) as watched:
        open_file(watched, page)
        assert psnr(watched.picture("interpolating/0", predicted.shape[:2], 1), predicted) >= 45
        assert watched.complaints == []
