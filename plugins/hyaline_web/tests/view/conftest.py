"""What tests of the viewer share: a folder with a dataset and a trained run."""

import dataclasses
from pathlib import Path

import pytest
import torch
from support.synthetic import write_synthetic_dataset
from support.training import SMALL

from model.run.train import train


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data/one and a trained run of it."""
    home = tmp_path_factory.mktemp("home")
    dataset = write_synthetic_dataset(home / "data" / "one", train_views=2)
    config = dataclasses.replace(SMALL, steps=2, held_out_views=0)
    train(config, dataset, home / "runs" / "one" / "paper", label="paper", device=torch.device("cpu"))
    return home


@pytest.fixture
def at_home(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(home)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
