"""Tests of the file that says what a training took."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from support.training import SMALL, call, run_bytes

from datagen.data.dataset import Dataset
from model.run.logs import COSTS, LogChoices, Meter, read_costs
from model.run.train import train

SHORT = dataclasses.replace(SMALL, steps=6, checkpoint_every=2)


def trained(dataset: Dataset, out: Path, *, costs: bool = True, overwrite: bool = False) -> Path:
    logs = LogChoices(costs=Meter() if costs else None)
    train(SHORT, dataset, out, label="run", device=torch.device("cpu"), logs=logs, overwrite=overwrite)
    return out


def test_a_training_says_what_it_took_and_every_other_byte_is_the_same(dataset: Dataset, tmp_path: Path) -> None:
    out = trained(dataset, tmp_path / "run")
    costs = read_costs(out)
    assert costs.keys() == {"seconds", "cpu_seconds", "peak_memory_bytes"}
    assert costs["seconds"] > 0
    assert costs["cpu_seconds"] > 0
    assert costs["peak_memory_bytes"] > 50e6  # PyTorch alone takes more.
    without = run_bytes(trained(dataset, tmp_path / "without", costs=False))
    assert {path: data for path, data in run_bytes(out).items() if path != COSTS} == without


def test_what_a_session_took_is_added_to_those_before_it_and_a_new_run_begins_anew(
    dataset: Dataset, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    before = {"seconds": 1000.0, "cpu_seconds": 2000.0, "peak_memory_bytes": 1e15}
    trained(dataset, out, costs=False)
    (out / "weights.pt").unlink()  # As one that was stopped.
    (out / COSTS).write_text(json.dumps(before))
    trained(dataset, out)
    costs = read_costs(out)
    assert 1000 < costs["seconds"]
    assert 2000 < costs["cpu_seconds"]
    assert costs["peak_memory_bytes"] == 1e15
    trained(dataset, out, overwrite=True)
    assert read_costs(out)["peak_memory_bytes"] < 1e15
    assert read_costs(out)["seconds"] < costs["seconds"]


def test_the_command_leaves_the_file_when_it_is_asked_to(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flags = ["paper", "--steps", "1", "--batch", "8", "--hidden", "8", "--texture-size", "8", "--device", "cpu"]
    for asked, is_left in (((), False), (("--costs",), True)):
        out = tmp_path / str(is_left)
        assert call(monkeypatch, "train", *flags, *asked, "--dataset", str(dataset.root), "--out", str(out)) == 0
        assert (out / COSTS).is_file() == is_left
    costs = read_costs(out)
    # It includes loading the weights, so four tiny pictures take at least a millisecond, and a second at most.
    assert 1 < costs["frames_per_second"] < 4000 and costs["seconds"] > 0


@pytest.mark.parametrize("content", ["", "{", "[]", '{"seconds": "long"}'])
def test_a_damaged_file_counts_as_none(tmp_path: Path, content: str) -> None:
    (tmp_path / COSTS).write_text(content)
    assert read_costs(tmp_path) == {}
