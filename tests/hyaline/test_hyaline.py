"""Tests hyaline from Python: its examples run, tensors equal what the files hold, nothing heavy is imported."""

import doctest
import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support.commands import parsed
from support.synthetic import write_synthetic_dataset

import hyaline


@pytest.fixture
def dataset(tmp_path: Path) -> hyaline.Dataset:
    write_synthetic_dataset(tmp_path / "data" / "glass_table")
    return hyaline.open_dataset("glass_table")


@pytest.mark.usefixtures("dataset")
@pytest.mark.parametrize(
    "name", ["hyaline", "hyaline.datasets", "hyaline.scenes", "hyaline.reports", "hyaline.tensors"]
)
def test_the_examples_of_the_documentation_print_what_they_say(name: str) -> None:
    results = doctest.testmod(importlib.import_module(name))
    assert results.attempted > 2 and results.failed == 0


def test_a_dataset_is_opened_by_name_folder_and_alone(dataset: hyaline.Dataset, tmp_path: Path) -> None:
    folder = tmp_path / "data" / "glass_table"
    assert {hyaline.open_dataset(given).seal for given in ("glass_table", folder, str(folder), None)} == {dataset.seal}
    with pytest.raises(hyaline.HyalineError, match="no dataset"):
        hyaline.open_dataset("nothing")
    for take in (dataset.views, dataset.cameras, dataset.noise_ceiling_db):
        with pytest.raises(hyaline.HyalineError, match="no split 'trian'; expected one of train"):
            take("trian")  # pyright: ignore[reportArgumentType]


def test_views_and_rays_are_those_of_the_files(dataset: hyaline.Dataset) -> None:
    views, rays = hyaline.ViewDataset(dataset, "train"), hyaline.RayDataset(dataset, "train")
    (batch,) = torch.utils.data.DataLoader(views, batch_size=len(views))
    view = dataset.view("train", 3)
    assert torch.equal((255 * batch["image"][3]).round().byte().permute(1, 2, 0), torch.tensor(view.image))
    assert np.allclose(batch["uv"][3].permute(0, 2, 3, 1).numpy() * 65535, view.layers().uv, atol=0.01)
    assert torch.equal(batch["object_id"][3], torch.tensor(view.layers().object_id))
    row, column, side = 7, 11, dataset.config.resolution.width
    ray = rays[(3 * side + row) * side + column]
    assert torch.equal(ray["color"], batch["image"][3][:, row, column])
    assert torch.equal(ray["direction"], batch["directions"][3][:, row, column])
    assert torch.equal(ray["origin"], batch["origin"][3])
    view.camera.world_from_camera[2, 3] += 1  # A camera of one's own.
    assert torch.equal(ray["origin"], torch.tensor(dataset.view("train", 3).camera.world_from_camera[:3, 3]).float())
    with pytest.raises(IndexError, match="expected 0 to 7"):
        views[8]


def test_importing_it_brings_neither_torch_nor_mitsuba() -> None:
    heavy = {"torch", "mitsuba", "drjit", "scipy", "matplotlib", "skimage"}
    code = f"import hyaline, sys; print({heavy} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"
    assert all(hasattr(hyaline, name) for name in hyaline.__all__)


def test_the_example_runs(dataset: hyaline.Dataset) -> None:
    example = Path(__file__).resolve().parents[2] / "examples" / "look_at_a_view.py"
    command = [sys.executable, str(example), str(dataset.root)]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "a ray meets" in answer.stdout and "the mean training colour scores " in answer.stdout


@pytest.mark.parametrize(
    ("words", "same"),
    [
        ("build random --seed 3", "datagen build random --seed 3"),
        ("film dataset glass --spp 2", "datagen film glass --spp 2"),
        ("film run glass/paper", "model film glass/paper"),
        ("proxies check --geometry box", "proxies check --geometry box"),
        ("report --format markdown", "report --format markdown"),
    ],
)
def test_the_program_hyaline_calls_what_the_others_call(words: str, same: str) -> None:
    assert parsed(f"hyaline {words}") == parsed(same)
