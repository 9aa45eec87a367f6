"""Tests of a run's logs: pictures of held-out views and costs, who deletes them, and that all else is the same."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from support.builds import tree
from support.commands import call
from support.synthetic import write_synthetic_dataset
from support.training import SMALL, load, quick

from datagen.data.dataset import Dataset
from datagen.data.images import read_png
from datagen.disk.ownership import holding
from model.run.logs import GAP
from model.run.predict import load_renderer, predict_pixels
from model.run.run_folder import FOLDER, begin_run, read_run
from model.run.train import train

CONFIG = dataclasses.replace(SMALL, steps=5, evaluate_every=2, checkpoint_every=2)
SNAPSHOTS = [f"snapshots/{step:06d}.png" for step in (2, 4, 5)]
CPU = torch.device("cpu")

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("snapshots") / "data" / "synthetic", resolution=16)


def test_each_evaluation_leaves_the_scored_pixels_above_their_prediction_and_a_new_run_deletes_them(
    dataset: Dataset, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    with holding(out, FOLDER):  # As the command does: it clears what killed writers left.
        train(CONFIG, dataset, out, label="run", device=CPU)
    assert sorted(path for path in tree(out) if path.endswith(".png")) == SNAPSHOTS
    last = read_png(out / SNAPSHOTS[-1])
    view = dataset.view("train", 4)  # Of eight views the middle one is held out.
    assert last.shape == (2 * 8 + GAP, 8, 3)
    assert np.array_equal(last[:8], view.image[::2, ::2])
    assert (last[8 : 8 + GAP] == 255).all()
    predicted = predict_pixels(load_renderer(out, CONFIG, dataset), load(CONFIG.net, dataset, [4]))
    thinned = predicted.reshape(16, 16, 3)[::2, ::2]
    assert thinned.std() > 1 and np.abs(last[-8:].astype(int) - thinned).max() <= 1  # Whole views take another loop.

    foreign = ["snapshots/2.png", "snapshots/000002.png.bak", "predictions/interpolating/mine.png"]
    for path in foreign:
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        (out / path).write_bytes(b"mine")
    begin_run(out, dataclasses.replace(read_run(out), seed=1), overwrite=True)
    assert sorted(tree(out)) == sorted([*foreign, "run.json"])


def test_costs_are_summed_over_the_sessions_of_a_run_and_change_no_other_byte(dataset: Dataset, tmp_path: Path) -> None:
    out, costs = tmp_path / "run", tmp_path / "run" / "costs.json"

    def trained(*flags: str) -> dict[str, bytes]:
        assert call(" ".join(["model", *quick(dataset, out), "--device", "cpu", *flags])).status == 0
        return tree(out)

    plain = trained()
    measured = trained("--costs", "--overwrite")
    found = json.loads(measured.pop("costs.json"))
    assert measured == plain
    assert found["seconds"] > 0 and found["cpu_seconds"] > 0
    assert found["peak_memory_bytes"] > 50e6  # PyTorch alone takes more.
    # It includes loading the weights, so four tiny pictures take at least a millisecond, and a second at most.
    assert 1 < found["frames_per_second"] < 4000

    before = {"seconds": 1000.0, "cpu_seconds": 2000.0, "peak_memory_bytes": 1e15}
    for stored, least in ((json.dumps(before), 1000), ("{", 0), ('{"seconds": "long"}', 0)):
        (out / "weights.pt").unlink()  # As one that was stopped.
        (out / "predictions.json").unlink()
        costs.write_text(stored)
        trained("--costs")
        found = json.loads(costs.read_text())
        assert least < found["seconds"] < least + 1000 and 2 * least < found["cpu_seconds"] < 2 * least + 1000
        assert (found["peak_memory_bytes"] == 1e15) == bool(least)
