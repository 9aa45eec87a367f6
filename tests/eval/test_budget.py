"""Tests the layer budget: `model train --use-layers`, and the table of quality against the number of layers."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from support.commands import Answer, call

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import Dataset
from datagen.data.images import png_bytes
from datagen.data.paths import TRUTH
from datagen.disk.records import to_json
from eval.analyses.coverage import missed_shares
from eval.page.report import make_report
from model.batches.rays import load_pixels
from model.methods.paper.config import PaperConfig
from model.run.predict import load_renderer, predict_pixels
from model.run.run_folder import TrainConfig, read_run

PAPER = TrainConfig(method="paper", geometry=TRUTH, net=PaperConfig(width=128, texture_size=16))


def write_run(dataset: Dataset, folder: Path, level: int, num_layers: int, size: int = 34_000, **net: object) -> None:
    """A run all of whose pixels are off by some levels of 255."""
    for split in TEST_SPLITS:
        (folder / "predictions" / split).mkdir(parents=True)
        for view in dataset.views(split):
            off = np.where(view.image < 128, view.image + np.uint8(level), view.image - np.uint8(level))
            (folder / "predictions" / split / f"{view.index:04d}.png").write_bytes(png_bytes(off))
    seed = int(net.pop("seed", 0))
    config = dataclasses.replace(PAPER, seed=seed, net=dataclasses.replace(PAPER.net, layers=str(num_layers), **net))
    record = {"dataset": dataset.root.as_posix(), "dataset_seal": dataset.seal, "method": "paper", "geometry": TRUTH}
    record |= {"seed": seed, "config": to_json(config), "num_layers": num_layers, "num_parameters": size}
    (folder / "run.json").write_text(json.dumps(record))


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
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs" / "synthetic"
    write_run(dataset, runs / "all", 3, 4)
    write_run(dataset, runs / "one", 20, 1)
    write_run(dataset, runs / "one-again", 30, 1, seed=1)
    write_run(dataset, runs / "wide", 5, 4, size=76_000, width=192)
    write_run(dataset, runs / "other", 9, 2, extrinsics="none")
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


def train(dataset: Dataset, out: Path, layers: str) -> Answer:
    size = "--steps 3 --batch 64 --texture-size 16 --hidden 32 --device cpu"
    return call(f"model train paper {size} {dataset.root} --out {out} --use-layers {layers}")


def test_a_small_budget_sees_the_nearest_layers_alone(dataset: Dataset, tmp_path: Path) -> None:
    assert train(dataset, tmp_path / "run", "2").status == 0
    record = read_run(tmp_path / "run")
    assert record.num_layers == 2
    renderer = load_renderer(tmp_path / "run", record.config, dataset)
    whole = load_pixels(dataset, TRUTH, "interpolating", [0])
    part = load_pixels(dataset, TRUTH, "interpolating", [0], max_layers=2)
    assert part.object_id.shape[1] == 2
    assert torch.equal(part.object_id, whole.object_id[:, :2])
    assert torch.equal(part.uv, whole.uv[:, :2])
    assert predict_pixels(renderer, part).shape == (256, 3)


@pytest.mark.parametrize("layers", ["0", "5"])
def test_other_numbers_of_layers_than_are_stored_are_refused(dataset: Dataset, tmp_path: Path, layers: str) -> None:
    answer = train(dataset, tmp_path / "run", layers)
    assert answer.status == 1
    assert f"error: layers: is {layers}; expected 1 to 4, the number of stored layers" in answer.err
    assert not (tmp_path / "run").exists()
