"""Tests that an opened run draws what it predicted, what cameras elsewhere see, and refuses the rest in one line."""

import dataclasses
import doctest
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from support.commands import run as command
from support.synthetic import write_synthetic_dataset

import hyaline
from datagen.data.images import read_png

METHODS = {
    "paper": "paper --texture-size 16 --hidden 32",
    "paper-rays": "paper --texture-size 16 --hidden 32 --render-rays 4",
    "dnr": "dnr --texture-size 16 --unet-width 4",
    "light-path": "light-path --texture-size 16 --render-rays 4 --refined-rays 9 --branches 4",
}
"""Runs of each kind of method by name, with the flags that make them small."""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data/glass_table, whose layers are traced, and its runs."""
    home = tmp_path_factory.mktemp("home")
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        torch.set_num_threads(1)
        write_synthetic_dataset(home / "data" / "glass_table")
        command("datagen peel data/glass_table --num-layers 4 --overwrite")
        for name, words in METHODS.items():
            command(f"model train {words} --dataset glass_table --steps 3 --batch 64 --out runs/glass_table/{name}")
        torch.set_num_threads(threads)
    return home


@pytest.fixture(autouse=True)
def at_home(home: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Tests start in it, on one thread, as the runs were predicted."""
    monkeypatch.chdir(home)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("name", METHODS)
def test_a_views_camera_gives_the_pixels_of_the_runs_own_prediction(home: Path, name: str) -> None:
    run = hyaline.open_run(f"glass_table/{name}")
    for split in hyaline.TEST_SPLITS:
        drawn = run.render(run.dataset.view(split, 1).camera)
        assert np.array_equal(drawn, read_png(home / "runs/glass_table" / name / "predictions" / split / "0001.png"))


@pytest.mark.parametrize("name", ["paper", "paper-rays", "light-path"])
def test_a_wide_low_picture_is_the_middle_of_the_whole_one(name: str) -> None:
    run = hyaline.open_run(f"glass_table/{name}")
    whole = run.dataset.view("interpolating", 0).camera
    fov_x = 2 * math.atan(math.tan(whole.fov_x / 2) * 24 / whole.width)
    part = run.render(dataclasses.replace(whole, fov_x=fov_x, width=24, height=10))
    differs = np.abs(part.astype(int) - run.render(whole)[11:21, 4:28]) > 1
    assert part.shape == (10, 24, 3) and differs.any(axis=-1).mean() < 0.02  # Rays along edges are rounded elsewhere.


def test_radiance_is_what_the_picture_shows_and_goes_on_beyond_white() -> None:
    run = hyaline.open_run("glass_table/light-path")
    camera = run.dataset.view("extrapolating", 0).camera
    radiance = run.radiance(camera)
    curve = np.where(radiance <= 0.0031308, 12.92 * radiance, 1.055 * np.maximum(radiance, 1e-9) ** (1 / 2.4) - 0.055)
    assert np.array_equal(np.rint(255 * np.clip(curve, 0, 1)), run.render(camera)) and radiance.dtype == np.float32
    with pytest.raises(hyaline.HyalineError, match="paper predicts display-referred colours, not radiance; use render"):
        hyaline.open_run("glass_table/paper").radiance(camera)


def test_a_run_says_what_it_is_and_is_found_from_elsewhere(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    run = hyaline.open_run(home / "runs" / "glass_table" / "paper")
    assert (run.method, run.geometry, run.last_step) == ("paper", "truth", 3)
    assert run.dataset.seal == run.record.dataset_seal and run.config.batch == 64
    assert [line["step"] for line in run.metrics] == [3]
    assert hyaline.list_runs(home / "runs") == sorted(f"glass_table/{name}" for name in METHODS)


def refusal(name: str, camera: hyaline.Camera) -> str:
    with pytest.raises(hyaline.HyalineError) as caught:
        hyaline.open_run(name).render(camera)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_cannot_be_drawn_is_refused_in_one_line(home: Path, tmp_path: Path) -> None:
    camera = hyaline.open_dataset().view("train", 0).camera
    mirrored = camera.world_from_camera * [[-1, 1, 1, 1]]
    for wrong in ({"width": 0}, {"fov_x": 3.5}, {"world_from_camera": mirrored}):
        with pytest.raises(hyaline.HyalineError, match=r"^camera: "):
            dataclasses.replace(camera, **wrong)
    (tmp_path / "splats" / "predictions").mkdir(parents=True)
    assert "holds no run; " in refusal(str(tmp_path / "splats"), camera)
    assert "choose from glass_table/dnr, " in refusal("glass_table/nothing", camera)


def test_cameras_on_a_circle_keep_distance_and_height_and_look_at_its_middle() -> None:
    start = hyaline.open_dataset().view("train", 0).camera
    target = np.array([0.1, -0.2, 0.3])
    cameras = hyaline.orbit(start, tuple(target), 6, turn_deg=180)
    places = np.array([camera.world_from_camera[:3, 3] for camera in cameras])
    offsets = places - target
    assert np.allclose(places[0], start.world_from_camera[:3, 3])
    assert np.allclose(np.linalg.norm(offsets, axis=1), np.linalg.norm(offsets[0]))
    azimuth = np.unwrap(np.arctan2(offsets[:, 1], offsets[:, 0]))
    assert np.allclose(np.diff(azimuth), math.pi / 6) and np.allclose(places[:, 2], places[0, 2])
    forward = np.array([-camera.world_from_camera[:3, 2] for camera in cameras])
    assert np.allclose(forward, -offsets / np.linalg.norm(offsets, axis=1, keepdims=True))


def test_intrinsics_give_the_camera_that_has_them_or_are_refused() -> None:
    camera = dataclasses.replace(hyaline.open_dataset().view("train", 0).camera, width=40, height=30)
    again = hyaline.camera_from_intrinsics(camera.world_from_camera, camera.intrinsics, 40, 30)
    assert again.fov_x == pytest.approx(camera.fov_x) and np.array_equal(again.rays()[1], camera.rays()[1])
    aside = np.add(camera.intrinsics, [[0, 0, 3], [0, 0, -2.5], [0, 0, 0]])
    moved = hyaline.camera_from_intrinsics(camera.world_from_camera, aside, 40, 30)
    assert moved.center == (23, 12.5) and np.allclose(moved.intrinsics, aside)
    for row, column in ((1, 1), (0, 1)):
        wrong = camera.intrinsics
        wrong[row, column] += 3
        with pytest.raises(hyaline.HyalineError, match="expected square pixels"):
            hyaline.camera_from_intrinsics(camera.world_from_camera, wrong, 40, 30)
    for wrong in (camera.intrinsics.T, 2 * camera.intrinsics):
        with pytest.raises(hyaline.HyalineError, match="expected zeros below the diagonal"):
            hyaline.camera_from_intrinsics(camera.world_from_camera, wrong, 40, 30)


def test_the_examples_of_the_documentation_print_what_they_say(
    home: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "runs" / "glass_table").mkdir(parents=True)
    (tmp_path / "runs" / "glass_table" / "paper").symlink_to(home / "runs" / "glass_table" / "paper")
    (tmp_path / "data").symlink_to(home / "data")
    monkeypatch.chdir(tmp_path)
    for module in (hyaline.cameras, hyaline.runs):
        results = doctest.testmod(module)
        assert results.attempted > 5 and results.failed == 0
