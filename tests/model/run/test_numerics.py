"""Tests that a number that is not finite, wherever it comes from, stops a command before it is kept or shown."""

import dataclasses
import inspect
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

import eval.cli
import model.cli
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


@pytest.fixture
def call(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], int]:
    """`train` or `report` in this process; answers its exit status."""
    make = inspect.unwrap(TrainConfig.__init__)
    defaults = (make.__kwdefaults__ or {}) | {"checkpoint_every": 2, "evaluate_every": 5}
    monkeypatch.setattr(make, "__kwdefaults__", defaults)
    lines = {
        "train": f"model train paper {dataset.root} --out {tmp_path}/runs/synthetic/paper --steps 8 "
        "--batch 64 --texture-size 16 --hidden 32 --device cpu",
        "report": f"report {tmp_path}/runs --data {dataset.root.parent} --out {tmp_path}/report",
    }

    def command(name: str) -> int:
        monkeypatch.setattr(sys, "argv", lines[name].split())
        try:
            (model.cli if name == "train" else eval.cli).main()
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    return command


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


@pytest.mark.promise("R10")
@pytest.mark.parametrize("site", SITES)
def test_training_stops_before_it_keeps_a_number_that_is_not_finite(
    call: Callable[[str], int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    site: str,
) -> None:
    inject(monkeypatch, site)
    assert call("train") == 3
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: ") and SITES[site] in last
    out = tmp_path / "runs/synthetic/paper"
    kept = load_state(out / "checkpoint.pt")
    assert kept["step"] == LAST_GOOD
    assert not (out / "weights.pt").exists() and not list(out.rglob("*.png"))
    assert not (out / "metrics.jsonl").exists()


@pytest.mark.promise("R10")
def test_a_renderer_that_predicts_no_number_writes_no_picture(
    call: Callable[[str], int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    draw = predict.render_predictions

    def poisoned(*given: object, **named: object) -> int:
        colors = predict.predict_colors
        with monkeypatch.context() as patch:
            patch.setattr(predict, "predict_colors", lambda *those: poison(colors(*those).clone()))
            return draw(*given, **named)  # pyright: ignore[reportArgumentType]

    with monkeypatch.context() as patch:
        patch.setattr(predict, "render_predictions", poisoned)
        assert call("train") == 3
    out = tmp_path / "runs/synthetic/paper"
    assert (
        f"error: {out}/predictions/interpolating/0000.png: a predicted colour is not finite" in capsys.readouterr().err
    )
    pictures = out / "predictions"
    assert not list(pictures.rglob("*.png")) and not (out / "predictions.json").exists()
    assert call("train") == 0
    assert len(list(pictures.rglob("*.png"))) == 4


@pytest.mark.promise("R10")
def test_a_metric_that_is_no_number_reaches_no_table(
    call: Callable[[str], int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("train") == 0
    capsys.readouterr()
    monkeypatch.setattr("eval.score.scores.ssim", lambda *_: NAN)
    assert call("report") == 3
    said = capsys.readouterr()
    assert said.err.splitlines()[-1].endswith(
        "predictions/interpolating/0000.png: its ssim is not a number; run not scored"
    )
    assert said.out == "" and not (tmp_path / "report/results.json").exists()
