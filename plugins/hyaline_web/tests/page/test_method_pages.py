"""Tests that a distribution of somebody else's brings a page for its own method: the example of the documentation."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image
from support.commands import call
from support.plugins import install_from_guide
from support.synthetic import write_synthetic_dataset
from support.web_scenes import psnr

from benchmarks.browser import open_file, watched_page

if TYPE_CHECKING:
    from playwright.sync_api import Browser


def test_the_page_of_the_guides_method_draws_what_its_run_predicts(
    browser: "Browser", tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "installed").mkdir()
    (module,) = install_from_guide(tmp_path / "installed", "A web page of a method")
    monkeypatch.syspath_prepend(tmp_path / "installed")
    dataset = write_synthetic_dataset(tmp_path / "data")
    run, page = tmp_path / "run", tmp_path / "page.html"
    trained = call(f"model train first-surface --dataset {dataset.root} --out {run} --steps 100 --batch 256 --lr 0.05")
    assert trained.status == 0, trained.err
    assert call(f"model export {run} --out {page} --quality exact").status == 0
    sys.modules.pop(module)
    predicted = np.asarray(Image.open(run / "predictions" / "interpolating" / "0000.png"))
    assert predicted.std() > 10
    with watched_page(browser) as watched:
        open_file(watched, page)
        assert psnr(watched.picture("interpolating/0", predicted.shape[:2], 1), predicted) >= 45
        assert watched.complaints == []
