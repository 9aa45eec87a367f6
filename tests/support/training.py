"""Training runs of a few steps: how they are configured, stopped and compared."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from support.builds import tree

from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from model.methods.paper.config import PaperConfig
from model.methods.protocol import MethodConfig, open_inputs
from model.run import train as train_module
from model.run.predict import render_predictions
from model.run.run_folder import TrainConfig, is_drawn
from model.run.train_flags import configure, parse_train

SMALL = TrainConfig(
    method="paper",
    geometry="truth",
    net=PaperConfig(width=32, texture_size=24, position_size=64),
    steps=20,
    batch=256,
    evaluate_every=5,
    checkpoint_every=4,
)


def stop_at(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """Kills training before a step's optimiser, as a power cut would: nothing after it runs."""
    check = train_module.read_finite

    def die(loss: torch.Tensor, renderer: torch.nn.Module, *, step: int, out: Path, last: int = step) -> float:
        if step == last:
            raise KeyboardInterrupt
        return check(loss, renderer, step=step, out=out)

    monkeypatch.setattr(train_module, "read_finite", die)


def assert_resumes(
    monkeypatch: pytest.MonkeyPatch, config: TrainConfig, dataset: Dataset, folder: Path, *, stop: int
) -> None:
    """Trains FOLDER/whole at once and FOLDER/parts with a stop, and draws both: they have the same bytes."""
    device = torch.device("cpu")
    train_module.train(config, dataset, folder / "whole", label="a", device=device)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        stop_at(patch, stop)
        train_module.train(config, dataset, folder / "parts", label="a", device=device)
    train_module.train(config, dataset, folder / "parts", label="a", device=device)
    for out in (folder / "whole", folder / "parts"):
        render_predictions(out, config, dataset, device=device)
        assert is_drawn(out, dataset)
    assert tree(folder / "whole") == tree(folder / "parts")


def quick(dataset: Dataset, out: Path) -> tuple[str, ...]:
    size = ("--steps", "3", "--batch", "64", "--texture-size", "16", "--hidden", "32")
    return ("train", "paper", "--dataset", str(dataset.root), "--out", str(out), *size)


def build(net: MethodConfig, dataset: Dataset, geometry: str = TRUTH) -> Any:
    """A fresh renderer of a method."""
    return net.build(open_inputs(net, dataset, geometry))


def load(net: MethodConfig, dataset: Dataset, views: Sequence[int], geometry: str = TRUTH) -> Any:
    """The pixels of training views, as a method takes them."""
    return net.load(open_inputs(net, dataset, geometry), "train", views, with_images=True)


def configured(dataset: Dataset, method: str, *flags: str) -> TrainConfig:
    """What `model train METHOD --flags` would train."""
    return configure(method, parse_train(method, (str(dataset.root), *flags)), dataset)
