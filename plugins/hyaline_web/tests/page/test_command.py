"""Tests `model export`: a trained run in, one page out, and what is refused."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from support.synthetic import write_synthetic_dataset
from support.training import SMALL, call

from datagen.data.dataset import Dataset
from datagen.data.images import png_bytes
from datagen.machine.mitsuba_variant import use_mitsuba
from hyaline_paper.methods import AuthorsConfig
from model.methods.light_path.config import LightPathConfig
from model.run.run_folder import TrainConfig
from model.run.train import train

use_mitsuba()

LIGHT_PATH = TrainConfig(
    method="light-path",
    geometry="truth",
    steps=1,
    batch=16,
    evaluate_every=1,
    net=LightPathConfig(texture_sizes=(8, 8), hidden=8, stack_hidden=4, branches=2, train_samples=1, debias=0.0),
)


ALL_VIEWS = [f"{split}/{view}" for split in ("extrapolating", "interpolating", "train") for view in (0, 1)]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("export") / "data" / "synthetic", train_views=2)


def trained(config: TrainConfig, dataset: Dataset, out: Path) -> Path:
    """A run of a step, with the one prediction that a page shows."""
    train(config, dataset, out, label="run", device=torch.device("cpu"))
    still = out / "predictions" / "interpolating" / "0000.png"
    still.parent.mkdir(parents=True)
    still.write_bytes(png_bytes(np.zeros((4, 4, 3), np.uint8)))
    return out


def truths_of(page: bytes) -> list[str]:
    """The views whose pictures a page has."""
    listed = re.search(rb'id="manifest">(.*?)</script>', page)
    assert listed is not None
    return sorted(json.loads(listed[1])["truth"])


def test_a_run_becomes_one_page_of_the_same_bytes_each_time_and_replaces_no_file_unasked(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = trained(LIGHT_PATH, dataset, tmp_path / "run")
    pages = [tmp_path / "one.html", tmp_path / "two.html"]
    for page in pages:
        assert call(monkeypatch, "export", str(run), "--out", str(page)) == 0
        assert capsys.readouterr().out == f"{page}\n"
    data = pages[0].read_bytes()
    assert data == pages[1].read_bytes()
    assert data.startswith(b"<!doctype html>")
    assert truths_of(data) == ALL_VIEWS
    assert b"http://" not in data
    assert b"https://" not in data
    assert call(monkeypatch, "export", str(run), "--out", str(pages[0])) == 1
    assert "is there already; pass --overwrite" in capsys.readouterr().err
    (run / "predictions" / "interpolating" / "0000.png").unlink()
    assert call(monkeypatch, "export", str(run), "--out", str(pages[0]), "--overwrite") == 1
    assert "render it with `model predict" in capsys.readouterr().err


def test_a_run_of_a_method_without_a_page_is_refused(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    net = AuthorsConfig(texture_size=16, position_size=32)
    run = trained(dataclasses.replace(SMALL, method="authors-code", net=net, steps=1), dataset, tmp_path / "run")
    assert call(monkeypatch, "export", str(run), "--out", str(tmp_path / "page.html")) == 1
    assert "its method, authors-code, has no web page; docs/browser.md lists those that do" in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()
