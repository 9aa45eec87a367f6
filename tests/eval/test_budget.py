"""Tests the layer budget: `model train --layers`, and the table of quality against the number of layers."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support.synthetic import write_synthetic_dataset

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from eval.analyses.coverage import missed_shares
from eval.page.report import make_report
from model import cli
from model.batches.rays import load_pixels
from model.run.predict import load_renderer, predict_pixels
from model.run.run_folder import read_run

FLAGS = ("paper", "--steps", "3", "--batch", "64", "--texture-size", "16", "--width", "128", "--device", "cpu")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("budget") / "data" / "synthetic", resolution=16)


def train(monkeypatch: pytest.MonkeyPatch, dataset: Dataset, out: Path, *more: str) -> int:
    command = ["model", "train", *FLAGS, "--dataset", str(dataset.root), "--out", str(out), *more]
    monkeypatch.setattr(sys, "argv", command)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        cli.main()
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        torch.set_num_threads(threads)
    return 0


def test_shares_equal_a_loop_over_rays(dataset: Dataset) -> None:
    found = missed_shares(dataset, TRUTH, [1, 2, 4])
    for split in TEST_SPLITS:
        more, deeper, rays = {1: 0, 2: 0}, {1: 0, 2: 0}, 0
        for view in range(2):
            ids = dataset.view(split, view).layers().object_id
            for row, column in np.ndindex(16, 16):
                names = [name for name in ids[:, row, column] if name]
                seen = names[: names.index(2) + 1] if 2 in names else names  # The floor, 2, is opaque.
                rays += 1
                for count in (1, 2):
                    more[count] += len(names) > count
                    deeper[count] += len(seen) > count
        for count in (1, 2):
            assert found[count][0][split] == pytest.approx(more[count] / rays)
            assert found[count][1][split] == pytest.approx(deeper[count] / rays)
        assert found[1][1][split] > 0.1  # Behind the pane there is a floor.
        assert (found[4][0][split], found[4][1][split]) == (0, 0)


def test_runs_of_several_budgets_make_a_table_and_a_figure(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs" / "synthetic"
    assert train(monkeypatch, dataset, runs / "all") == 0
    assert train(monkeypatch, dataset, runs / "one", "--layers", "1") == 0
    assert train(monkeypatch, dataset, runs / "one-again", "--layers", "1", "--seed", "1") == 0
    assert train(monkeypatch, dataset, runs / "wide", "--width", "192") == 0
    assert train(monkeypatch, dataset, runs / "other", "--layers", "2", "--extrinsics", "none") == 0
    assert [read_run(runs / name).num_layers for name in ("all", "one")] == [4, 1]
    capsys.readouterr()

    make_report(tmp_path / "runs", dataset.root.parent, tmp_path / "out", output_format="markdown", is_full=True)
    assert "synthetic: layer budget" in capsys.readouterr().out
    scene = json.loads((tmp_path / "out/results.json").read_text())["scenes"][0]
    (budget,) = scene["analyses"]["layer_budgets"]  # `wide` and `other` stand alone.
    assert budget["name"] == "all"
    assert [(point["num_layers"], point["runs"]) for point in budget["points"]] == [
        (1, ["one", "one-again"]),
        (4, ["all"]),
    ]
    scores = {run["run"]: run["splits"]["extrapolating"]["psnr_db"]["mean"] for run in scene["runs"]}
    mean = (scores["one"] + scores["one-again"]) / 2
    assert budget["points"][0]["psnr_db"]["extrapolating"] == pytest.approx(mean)
    assert (tmp_path / "out/budget_synthetic.svg").is_file()


def test_a_small_budget_sees_the_nearest_layers_alone(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert train(monkeypatch, dataset, tmp_path / "run", "--layers", "2") == 0
    config = read_run(tmp_path / "run").config
    renderer = load_renderer(tmp_path / "run", config, dataset)
    whole = load_pixels(dataset, TRUTH, "interpolating", [0])
    part = load_pixels(dataset, TRUTH, "interpolating", [0], max_layers=2)
    assert part.object_id.shape[1] == 2
    assert torch.equal(part.object_id, whole.object_id[:, :2])
    assert torch.equal(part.uv, whole.uv[:, :2])
    assert predict_pixels(renderer, part).shape == (256, 3)


@pytest.mark.parametrize("layers", ["0", "5"])
def test_other_numbers_of_layers_than_are_stored_are_refused(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], layers: str
) -> None:
    assert train(monkeypatch, dataset, tmp_path / "run", "--layers", layers) == 1
    assert f"error: layers: is {layers}; expected 1 to 4, the number of stored layers" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
