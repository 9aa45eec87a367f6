"""Tests of training, checkpoints, run folders and the command `model`."""

import dataclasses
import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.builds import tree
from support.commands import Answer, call
from support.synthetic import write_synthetic_dataset
from support.training import SMALL, quick

from datagen.data.dataset import Dataset
from datagen.data.images import read_png
from datagen.disk.errors import HyalineError
from datagen.disk.records import seal_bytes
from model.methods.paper.config import DnrConfig
from model.run.predict import render_predictions
from model.run.run_folder import check_trained_on, is_drawn, read_run
from model.run.train import train
from model.settings import decay
from model.state import fingerprint, load_state

pytestmark = pytest.mark.usefixtures("one_thread")


CPU = torch.device("cpu")


DNR = DnrConfig(texture_size=24, position_size=64, unet_width=8, crop=32)


@pytest.mark.parametrize(
    ("settings", "views", "least"),
    [
        ({"steps": 400, "batch": 512, "lr": 0.01}, 8, 27),  # Flipped uv score 17 dB.
        ({"method": "dnr", "net": DNR, "steps": 80, "batch": 2048, "lr": 0.01}, 24, 19),
    ],
)
def test_training_learns_the_pane_and_the_floor(
    tmp_path: Path, settings: dict[str, Any], views: int, least: float
) -> None:
    """The mean colour of the training images scores 14 dB."""
    dataset = write_synthetic_dataset(tmp_path / "data", train_views=views)
    config = dataclasses.replace(SMALL, **settings, evaluate_every=400, checkpoint_every=1000)
    train(config, dataset, tmp_path / "run", label="paper", device=CPU)
    render_predictions(tmp_path / "run", config, dataset, device=CPU)
    scores = []
    for view in range(2):
        prediction = read_png(tmp_path / f"run/predictions/interpolating/000{view}.png").astype(np.float64)
        truth = dataset.view("interpolating", view).image
        scores.append(-10 * np.log10(np.mean((prediction - truth) ** 2) / 255**2))
    assert np.mean(scores) > least
    assert is_drawn(tmp_path / "run", dataset)


def test_a_fingerprint_depends_on_values_and_not_on_the_order_of_keys() -> None:
    state = {"a": torch.ones(3), "b": {"c": [1, 2]}}
    assert fingerprint(dict(reversed(state.items()))) == fingerprint(state)  # pyright: ignore[reportArgumentType]
    assert fingerprint({**state, "a": torch.ones(3, 1)}) != fingerprint(state)  # pyright: ignore[reportArgumentType]
    assert fingerprint({**state, "b": {"c": [1, 3]}}) != fingerprint(state)  # pyright: ignore[reportArgumentType]


def test_textures_that_no_ray_touches_stay_as_they_were(dataset: Dataset, tmp_path: Path) -> None:
    big = dataclasses.replace(SMALL, net=dataclasses.replace(SMALL.net, texture_size=200), steps=3, batch=64)
    train(big, dataset, tmp_path / "run", label="paper", device=CPU)
    table = load_state(tmp_path / "run/weights.pt")["renderer"]["textures.table"]  # pyright: ignore
    changed = table.ne(0).any(dim=1).sum()  # pyright: ignore
    assert 0 < changed <= 3 * 64 * 2 * 4


def test_run_json_says_what_was_trained_on_what(dataset: Dataset, tmp_path: Path) -> None:
    train(dataclasses.replace(SMALL, steps=1), dataset, tmp_path / "run", label="mine", device=CPU)
    record = read_run(tmp_path / "run")
    assert (record.method, record.geometry, record.knowledge) == ("paper", "truth", "true geometry")
    assert (record.label, record.dataset_seal, record.config.steps) == ("mine", dataset.seal, 1)
    assert record.num_texture_parameters == 2 * 24 * 24 * 16
    content = json.loads((tmp_path / "run/run.json").read_text())
    content["config"]["stepz"] = 3
    (tmp_path / "run/run.json").write_text(json.dumps(content))
    with pytest.raises(HyalineError, match="does not match its own checksum"):
        read_run(tmp_path / "run")
    del content["sha256"]
    (tmp_path / "run/run.json").write_bytes(seal_bytes(content))
    with pytest.raises(HyalineError, match="config: unknown key 'stepz'"):
        read_run(tmp_path / "run")


def test_another_configuration_or_dataset_is_refused_by_name(dataset: Dataset, tmp_path: Path) -> None:
    config = dataclasses.replace(SMALL, steps=1)
    train(config, dataset, tmp_path, label="mine", device=CPU)
    check_trained_on(tmp_path, config, dataset)
    deeper = dataclasses.replace(config, net=dataclasses.replace(config.net, texture_size=32))
    with pytest.raises(HyalineError, match="another texture_size: 24 there, 32 here; start over with --overwrite"):
        check_trained_on(tmp_path, deeper, dataset)
    with pytest.raises(HyalineError, match="another dataset"):
        check_trained_on(tmp_path, config, dataclasses.replace(dataset, seal="else"))


def test_the_learning_rate_decays_as_named() -> None:
    assert [decay("linear", progress) for progress in (0.0, 0.5, 0.75)] == [1, 1, 0.5]
    assert [decay("none", progress) for progress in (0.0, 0.99)] == [1, 1]
    assert decay("cosine", 0.5) == pytest.approx(0.5)


# The command.


def quickly(dataset: Dataset, out: Path, *more: str) -> Answer:
    return call(shlex.join(["model", *quick(dataset, out), *more]))


def test_the_command_trains_skips_refuses_and_renders_again(dataset: Dataset, tmp_path: Path) -> None:
    out = tmp_path / "run"
    answer = quickly(dataset, out)
    assert (answer.status, answer.out, answer.error) == (0, f"{out}\n", f"next: eval report {tmp_path.parent}")
    before = tree(out)
    assert {"run.json", "weights.pt", "predictions.json", "predictions/extrapolating/0001.png"} <= set(before)

    assert "finished before, nothing to do" in quickly(dataset, out).err
    code = "import sys; from model.cli import main; main(); print('torch' in sys.modules)"
    again = subprocess.run([sys.executable, "-c", code, *quick(dataset, out)], capture_output=True, text=True)
    assert again.stdout == f"{out}\nFalse\n"

    answer = quickly(dataset, out, "--lr", "0.01")
    assert answer.status == 1
    assert "another lr: 0.001 there, 0.01 here; start over with --overwrite" in answer.err

    (out / "predictions/interpolating/0000.png").write_bytes(b"broken")
    assert call(f"model predict {out}").status == 0
    assert tree(out) == before
    (out / "predictions/interpolating/0000.png").write_bytes(b"broken")
    assert "run: is trained; continuing with its predictions" in quickly(dataset, out).err
    assert tree(out) == before

    assert quickly(dataset, out, "--overwrite").status == 0
    assert tree(out) == before  # Same command, same bytes.


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("--geometry", "truht"), "no geometry 'truht'; did you mean 'truth'"),
        (("--geometry", "box"), "no box proxies; make them with `proxies make --kind box`"),
        (("--hidden", "9"), "hidden: is 9 with 3 blocks; expected a multiple of 8"),
        (("--dataset", "no/where"), "no/where: no dataset; make one with `datagen build"),
    ],
)
def test_a_wrong_flag_is_one_line(dataset: Dataset, tmp_path: Path, changes: tuple[str, ...], message: str) -> None:
    answer = quickly(dataset, tmp_path / "run", *changes)
    assert answer.status == (2 if message.startswith("no geometry") else 1)
    assert message in answer.err and answer.err.startswith("error: ") and answer.err.count("\n") == 1
    assert not (tmp_path / "run").exists()
