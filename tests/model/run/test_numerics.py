"""Tests that a number that is not finite, wherever it comes from, stops a command before it is kept or shown."""

import dataclasses
import inspect
from pathlib import Path

import pytest
import torch
from support.commands import call, run
from torch import Tensor, nn

from datagen.data.dataset import Dataset
from model.batches.layers import Pixels
from model.batches.rays import RayBatch
from model.methods import renderer as losses
from model.run import predict
from model.run import train as train_module
from model.run.run_folder import TrainConfig
from model.state import load_state

pytestmark = pytest.mark.promise("R10")

NAN = float("nan")
LAST_GOOD = 4
"""The step of the last checkpoint before the poison, which is given in the step after it."""


TRAIN = (
    "model train paper {} --out runs/synthetic/paper --steps 8 --batch 64 --texture-size 16 --hidden 32 --device cpu"
)
OUT = Path("runs/synthetic/paper")


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints and evaluations of a run of eight steps."""
    make = inspect.unwrap(TrainConfig.__init__)
    defaults = (make.__kwdefaults__ or {}) | {"checkpoint_every": 2, "evaluate_every": 5}
    monkeypatch.setattr(make, "__kwdefaults__", defaults)


def poison(values: Tensor) -> Tensor:
    """One NaN in the first row."""
    with torch.no_grad():
        values[(0,) * values.ndim] = NAN
    return values


def inject(monkeypatch: pytest.MonkeyPatch, site: str) -> None:
    """Puts one NaN where it is asked for, in the step after the last good checkpoint."""
    step_now = 0
    check = train_module.read_finite

    def before_check(loss: torch.Tensor, renderer: nn.Module, *, step: int, out: Path) -> float:
        nonlocal step_now
        step_now = step + 1
        if step == LAST_GOOD and site == "gradient":
            poison(renderer.get_parameter("net.last.weight").grad)  # pyright: ignore[reportArgumentType]
        value = check(loss, renderer, step=step, out=out)
        if step == LAST_GOOD and site in ("textures.table", "net.first.linear.weight"):
            poison(renderer.get_parameter(site))
        return value

    monkeypatch.setattr(train_module, "read_finite", before_check)
    take_colors, take, colors = losses.take_colors, Pixels.take, predict.predict_colors

    def poisoned_colors(*given: object) -> Tensor:
        values = take_colors(*given)  # pyright: ignore[reportArgumentType]
        return poison(values) if step_now == LAST_GOOD else values

    def poisoned_rays(*given: object) -> RayBatch:
        rays = take(*given)  # pyright: ignore[reportArgumentType]
        return dataclasses.replace(rays, uv=poison(rays.uv)) if step_now == LAST_GOOD else rays

    if site == "image":
        monkeypatch.setattr(losses, "take_colors", poisoned_colors)
    elif site == "uv":
        monkeypatch.setattr(Pixels, "take", poisoned_rays)
    elif site == "prediction":
        monkeypatch.setattr(predict, "predict_colors", lambda *given: poison(colors(*given).clone()))


SITES = {
    "image": "the loss is nan at step 4, so training stopped; the checkpoint is kept",
    "uv": "uv: a layer has one that is not finite",
    "textures.table": "a predicted colour is not finite",
    "gradient": "the gradient of net.last.weight is not finite at step 4, so training stopped",
    "net.first.linear.weight": "a predicted colour is not finite",
    "prediction": "a predicted colour is not finite",
}


@pytest.mark.parametrize("site", SITES)
def test_training_stops_before_it_keeps_a_number_that_is_not_finite(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch, site: str
) -> None:
    inject(monkeypatch, site)
    answer = call(TRAIN.format(dataset.root))
    assert answer.status == 3
    assert answer.error.startswith("error: ") and SITES[site] in answer.error
    assert load_state(OUT / "checkpoint.pt")["step"] == LAST_GOOD
    assert not (OUT / "weights.pt").exists() and not list(OUT.rglob("*.png"))
    assert not (OUT / "metrics.jsonl").exists()


def test_a_renderer_that_predicts_no_number_writes_no_picture(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = predict.render_predictions

    def poisoned(*given: object, **named: object) -> int:
        colors = predict.predict_colors
        with monkeypatch.context() as patch:
            patch.setattr(predict, "predict_colors", lambda *those: poison(colors(*those).clone()))
            return draw(*given, **named)  # pyright: ignore[reportArgumentType]

    with monkeypatch.context() as patch:
        patch.setattr(predict, "render_predictions", poisoned)
        answer = call(TRAIN.format(dataset.root))
    assert answer.status == 3
    assert f"error: {OUT}/predictions/interpolating/0000.png: a predicted colour is not finite" in answer.err
    assert not list((OUT / "predictions").rglob("*.png")) and not (OUT / "predictions.json").exists()
    run(TRAIN.format(dataset.root))
    assert len(list((OUT / "predictions").rglob("*.png"))) == 4


def test_a_metric_that_is_no_number_reaches_no_table(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    run(TRAIN.format(dataset.root))
    monkeypatch.setattr("eval.score.metrics.ssim", lambda *_: NAN)
    answer = call(f"report --data {dataset.root.parent} --out report")
    assert (answer.status, answer.out) == (3, "")
    assert answer.error.endswith("predictions/interpolating/0000.png: its ssim is not a number; run not scored")
    assert not Path("report/results.json").exists()
