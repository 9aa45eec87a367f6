"""Tests which layers a method looks up: stored ones, the nearest of them, or those that are traced for each batch."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from support.commands import Answer, call
from support.training import load

from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from model.batches.layers import load_pixels
from model.methods.paper.config import PaperConfig
from model.run.predict import load_renderer, predict_pixels, render_predictions
from model.run.run_folder import TrainConfig, is_drawn, read_run
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


def train_few(dataset: Dataset, out: Path, layers: str) -> Answer:
    size = "--steps 3 --batch 64 --texture-size 16 --hidden 32 --device cpu"
    return call(f"model train paper {size} {dataset.root} --out {out} --use-layers {layers}")


def test_a_few_layers_are_the_nearest_ones(dataset: Dataset, tmp_path: Path) -> None:
    assert train_few(dataset, tmp_path / "run", "2").status == 0
    record = read_run(tmp_path / "run")
    assert record.num_layers == 2
    renderer = load_renderer(tmp_path / "run", record.config, dataset)
    whole = load_pixels(dataset, TRUTH, "interpolating", [0])
    part = load_pixels(dataset, TRUTH, "interpolating", [0], max_layers=2)
    assert part.object_id.shape[1] == 2
    assert torch.equal(part.object_id, whole.object_id[:, :2])
    assert torch.equal(part.uv, whole.uv[:, :2])
    assert predict_pixels(renderer, part).shape == (1024, 3)


@pytest.mark.parametrize("layers", ["0", "5"])
def test_other_numbers_of_layers_than_are_stored_are_refused(dataset: Dataset, tmp_path: Path, layers: str) -> None:
    answer = train_few(dataset, tmp_path / "run", layers)
    assert answer.status == 1
    assert f"error: layers: is {layers}; expected 1 to 4, the number of stored layers" in answer.err
    assert not (tmp_path / "run").exists()
