"""Tests which layers a method looks up: stored ones, the nearest of them, or those that are traced for each batch."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from support.commands import call
from support.training import load

from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from model.methods.paper.config import PaperConfig
from model.run.predict import render_predictions
from model.run.run_folder import TrainConfig, is_drawn
from model.run.train import train

CPU = torch.device("cpu")
NET = PaperConfig(width=16, texture_size=16, position_size=32, layers="online")


@pytest.mark.parametrize(
    ("text", "parsed"),
    [("all", (None, False)), ("4", (4, False)), ("online", (None, True)), ("online-4", (4, True))],
)
def test_layers_are_a_number_or_online_or_both(text: str, parsed: tuple) -> None:
    config = PaperConfig(layers=text)
    assert (config.asked_layers, config.traces_layers) == parsed
    for wrong in (f"{text}-", f"-{text}", f"{text}.5", ""):
        with pytest.raises(HyalineError, match="expected all, a number, online, or both such as online-4"):
            PaperConfig(layers=wrong)


def test_online_layers_are_the_stored_ones_through_centres_and_jittered_while_training(dataset: Dataset) -> None:
    stored = load(dataclasses.replace(NET, layers="all"), dataset, [2, 5])
    online = load(NET, dataset, [2, 5])
    index = torch.from_numpy(np.random.default_rng(0).permutation(2048)[:1000])
    expected, centers = stored.take(index, None), online.take(index, None)
    assert torch.equal(centers.object_id, expected.object_id)
    assert (centers.uv - expected.uv).abs().max() < 1e-4
    assert torch.equal(centers.p_camera, expected.p_camera)
    few = load(dataclasses.replace(NET, layers="online-2"), dataset, [2, 5]).take(index, None)
    assert torch.equal(few.object_id, expected.object_id[:, :2])
    first, second, again = (online.take(index, np.random.default_rng(seed)) for seed in (1, 2, 1))
    assert torch.equal(first.uv, again.uv) and first.samples == 1
    # A pixel is at most 0.07 of the pane wide here; a random place in it is nearly always another one.
    same = (first.object_id == second.object_id) & (first.object_id > 0)
    moved = (first.uv - second.uv).abs().amax(dim=-1)[same]
    assert 0 < moved.median() < 0.07 and (moved > 1e-4).float().mean() > 0.99


def test_online_training_reads_no_stored_layer(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a stored layer was read")

    monkeypatch.setattr("datagen.data.layers.LayerStore.read", refuse)
    config = TrainConfig(method="paper", geometry=TRUTH, net=NET, steps=4, batch=128)
    train(config, dataset, tmp_path / "run", label="a", device=CPU)
    render_predictions(tmp_path / "run", config, dataset, device=CPU)
    assert is_drawn(tmp_path / "run", dataset)


@pytest.mark.parametrize("layers", ["0", "5"])
def test_other_numbers_of_layers_than_are_stored_are_refused(dataset: Dataset, tmp_path: Path, layers: str) -> None:
    answer = call(f"model train paper {dataset.root} --out {tmp_path / 'run'} --use-layers {layers}")
    assert answer.status == 1
    assert f"error: layers: is {layers}; expected 1 to 4, the number of stored layers" in answer.err
    assert not (tmp_path / "run").exists()
