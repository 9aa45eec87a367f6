"""Tests the pictures of learned skies and of errors before and after."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from support.synthetic import write_synthetic_dataset

from benchmarks.drawings import draw_errors, draw_skies, find_worst, learned_sky, map_directions, true_sky
from datagen.data.dataset import Dataset
from datagen.data.images import png_bytes
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.folder import load_scene
from eval.score.runs import open_run
from model.methods.light_path.config import LightPathConfig
from model.run.predict import load_renderer
from model.run.run_folder import TrainConfig
from model.run.train import train

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("pictures") / "data" / "synthetic", train_views=2)


def write_run(dataset: Dataset, folder: Path, levels: dict[tuple[str, int], int]) -> Path:
    """Predictions that are off by so many levels of 255 in some views and right in all others."""
    for split in ("interpolating", "extrapolating"):
        (folder / "predictions" / split).mkdir(parents=True)
        for view in range(2):
            truth = dataset.view(split, view).image
            level = np.uint8(levels.get((split, view), 0))
            off = np.where(truth < 128, truth + level, truth - level)
            (folder / "predictions" / split / f"{view:04d}.png").write_bytes(png_bytes(off))
    record = {"dataset": dataset.root.as_posix(), "dataset_seal": dataset.seal, "method": "mine"}
    (folder / "run.json").write_text(json.dumps(record))
    return folder


def test_the_views_that_the_first_run_predicts_worst_come_first(dataset: Dataset, tmp_path: Path) -> None:
    levels = {("interpolating", 0): 5, ("interpolating", 1): 9, ("extrapolating", 0): 20}
    before = write_run(dataset, tmp_path / "before", levels)
    after = write_run(dataset, tmp_path / "after", {("extrapolating", 1): 40})
    runs = [open_run(folder, tmp_path) for folder in (before, after)]
    assert find_worst(runs, 2) == [("extrapolating", 0), ("interpolating", 1)]
    assert find_worst(runs[::-1], 1) == [("extrapolating", 1)]
    assert draw_errors(before, after, views=2).startswith(PNG)


def test_the_skies_of_a_dataset_and_of_a_run_are_what_these_say(dataset: Dataset, tmp_path: Path) -> None:
    if use_mitsuba(quiet=True).startswith("scalar"):
        pytest.skip("light paths need a vectorised variant of Mitsuba")
    net = LightPathConfig(texture_sizes=(8, 8), hidden=8, stack_hidden=0, environment_size=4, branches=2)
    config = TrainConfig(method="light-path", geometry="truth", net=net, steps=2, batch=16)
    train(config, dataset, tmp_path / "run", label="a", device=torch.device("cpu"))
    sky = load_scene(dataset.root / "scene").environment
    assert np.allclose(true_sky(dataset)[0], sky.zenith, atol=0.02)
    renderer = load_renderer(tmp_path / "run", config, dataset)
    with torch.no_grad():
        towards = renderer.environment(torch.from_numpy(map_directions()[30, 40]).float()[None])  # pyright: ignore[reportCallIssue]
    np.testing.assert_allclose(learned_sky(tmp_path / "run", dataset)[30, 40], towards[0].numpy(), rtol=1e-4)
    assert draw_skies((tmp_path / "run",), ("learned",)).startswith(PNG)
    with pytest.raises(HyalineError, match="names: are true for 1 runs; expected another one for each run"):
        draw_skies((tmp_path / "run",), ("true",))
