"""Tests variants end to end: splits by angle and larger truth, built, predicted and scored with the real commands."""

import dataclasses
import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence
from support.builds import tree
from support.commands import Answer, call
from support.synthetic import synthetic_scene

from datagen.builder.verify import verify_dataset
from datagen.data.config import ANGLE_SPLITS, TEST_SPLITS
from datagen.data.dataset import open_dataset
from datagen.data.images import read_png
from datagen.data.variants import evenly, has_variant, open_variant
from datagen.disk.errors import HyalineError
from datagen.quantities import quantities
from datagen.scene.folder import save_scene
from eval.page.report import make_report

FLAGS = (
    *("--preset", "tiny", "--resolution", "16", "--num-layers", "4"),
    *("--views", "3", "--test-views", "3", "--spp", "2", "--test-spp", "2"),
)
MORE = ("--angles", "--larger", "2", "--larger-views", "2", "--stereo", "0.06")


def command(*words: object) -> Answer:
    return call(shlex.join(map(str, words)))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """A folder with scene/mine and data/mine, variants and all, and what the dataset held before it got them."""
    root = tmp_path_factory.mktemp("variant")
    scene = synthetic_scene()
    rig = dataclasses.replace(scene.cameras, azimuth_deg=(-100, 100))
    save_scene(dataclasses.replace(scene, cameras=rig), root / "scene/mine")
    build = ("datagen", "build", "--scene", root / "scene/mine", "--out", root / "data/mine", *FLAGS)
    assert command(*build).status == 0
    plain = tree(root / "data/mine")
    assert command("datagen", "add", root / "data/mine", *MORE).status == 0
    return root, plain


def test_the_splits_by_angle_are_there_and_the_dataset_is_left_alone(made: tuple[Path, dict[str, bytes]]) -> None:
    root, plain = made
    after = tree(root / "data/mine")
    assert {path: data for path, data in after.items() if not path.startswith("variants/")} == plain
    found = verify_dataset(root / "data/mine")
    assert (len(found.files), found.problems) == (len(after), [])
    dataset = open_dataset(made[0] / "data/mine")
    variant = open_variant(dataset, "angles")
    assert variant.splits == tuple(ANGLE_SPLITS)
    assert variant.home.seal == dataset.seal != variant.seal
    for split, degrees in ANGLE_SPLITS.items():
        assert variant.cameras(split).world_from_camera.shape == (3, 4, 4)
        assert variant.view(split, 2).image.shape == (16, 16, 3)
        assert variant.view(split, 2).layers().object_id.any(), degrees


def test_larger_truth_is_that_of_the_same_cameras(made: tuple[Path, dict[str, bytes]]) -> None:
    dataset = open_dataset(made[0] / "data/mine")
    variant = open_variant(dataset, "x2")
    assert not has_variant(dataset, "x4")
    assert evenly(2, 3) == [0, 2]
    for split in TEST_SPLITS:
        small, large = dataset.cameras(split), variant.cameras(split)
        assert np.array_equal(large.world_from_camera, small.world_from_camera[[0, 2]])
        assert (large.width, large.fov_x) == (32, small.fov_x)
        # Averaged in fours, it is the smaller picture, but for noise.
        fine = variant.view(split, 1).image.astype(float).reshape(16, 2, 16, 2, 3).mean(axis=(1, 3))
        coarse = dataset.view(split, 2).image.astype(float)
        assert np.abs(fine - coarse).mean() < 0.5 * np.abs(fine - coarse.mean(axis=(0, 1))).mean()
        layers = variant.view(split, 0).layers()
        assert layers.object_id.shape == (4, 32, 32)


def test_every_view_has_a_right_one_with_noise_of_its_own(made: tuple[Path, dict[str, bytes]]) -> None:
    dataset = open_dataset(made[0] / "data/mine")
    right = open_variant(dataset, "stereo-60mm")
    assert right.num_views == dataset.num_views and right.home.seal == dataset.seal
    for split in right.splits:
        for left, other in zip(dataset.views(split), right.views(split), strict=True):
            moved = np.linalg.inv(left.camera.world_from_camera) @ other.camera.world_from_camera
            assert np.abs(moved - [[1, 0, 0, 0.06], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]).max() < 1e-12
            assert other.record.seed != left.record.seed and other.layers().object_id.any()


def test_a_labelled_film_shows_the_views_of_a_variant_that_goes_on(made: tuple[Path, dict[str, bytes]]) -> None:
    data, out = made[0] / "data/mine", made[0] / "film.webp"
    film = ("datagen", "film", data, "--labels", "--frames", 3, "--spp", 4, "--width", 24, "--out", out)
    assert command(*film).out.split() == [str(data / "variants/film-orbit"), str(out)]
    first = tree(data / "variants/film-orbit")
    frames = open_variant(open_dataset(data), "film-orbit").views("interpolating")
    with Image.open(out) as shown:
        for view, picture in zip(frames, ImageSequence.Iterator(shown), strict=True):
            assert np.abs(np.asarray(picture.convert("RGB")).astype(float) - view.image).mean() < 4
    depth = quantities(frames[2]).opaque_depth_along_axis
    assert depth.shape == (24, 24) and (depth > quantities(frames[2]).depth_along_axis).any()
    out.unlink()
    frames[1].record_path.unlink()
    assert command(*film).status == 0 and tree(data / "variants/film-orbit") == first
    shutil.rmtree(data / "variants/film-orbit")


def test_a_variant_of_other_data_is_refused_and_replaced(made: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    shutil.copytree(made[0] / "data/mine", tmp_path / "mine")
    build = ("datagen", "build", "--scene", made[0] / "scene/mine", "--out", tmp_path / "mine", *FLAGS)
    assert command(*build, "--seed", 1, "--overwrite").status == 0
    assert not (tmp_path / "mine/variants").exists()
    shutil.copytree(made[0] / "data/mine/variants", tmp_path / "mine/variants")
    with pytest.raises(HyalineError, match="belongs to a dataset that stood there before"):
        open_variant(open_dataset(tmp_path / "mine"), "angles")


def test_runs_predict_variants_and_the_report_scores_them(
    made: tuple[Path, dict[str, bytes]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, runs = made[0], tmp_path / "runs/mine"
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    hidden = tmp_path / "variants"
    (root / "data/mine/variants").rename(hidden)
    size = ("--steps", 3, "--batch", 64, "--hidden", 16, "--texture-size", 16)
    train = ("model", "train", "paper", root / "data/mine", *size)
    assert command(*train, "--device", "cpu", "--out", runs / "paper").status == 0
    hidden.rename(root / "data/mine/variants")
    drawn = runs / "paper/variants"
    assert not drawn.exists()
    # A finished run predicts splits that were built since, and no more after that.
    render = ("model", "predict", runs / "paper", "--device", "cpu")
    said = [command(*render, *words).err for words in ((), (), ("--variant", "x2"), ("--variant", "x2"))]
    torch.set_num_threads(threads)
    assert ["nothing to do" in text for text in said] == [False, True, False, True]
    assert read_png(drawn / "x2/predictions/extrapolating/0001.png").shape == (32, 32, 3)
    advice = "make it with `datagen add`"
    refused = command(*render, "--variant", "x4").err
    assert f"x4: no such variant (there are: angles, stereo-60mm, x2); {advice}" in refused

    # A foreign method that knows the truth, and one that enlarges its own pictures.
    dataset = open_dataset(root / "data/mine")
    for split in TEST_SPLITS:
        shutil.copytree(dataset.root / "images" / split, runs / "perfect/predictions" / split)
    for name in ("angles", "x2", "stereo-60mm"):
        shutil.copytree(root / "data/mine/variants" / name / "images", runs / "perfect/variants" / name / "predictions")
    make_report(tmp_path / "runs", root / "data", tmp_path / "out", output_format="markdown")
    text = capsys.readouterr().out
    scene = json.loads((tmp_path / "out/results.json").read_text())["scenes"][0]["analyses"]
    runs_by_angle = scene["variants"]["angles"]["runs"]
    assert set(runs_by_angle) == {"paper", "perfect"}
    error = (
        read_png(drawn / "angles/predictions/extrapolating-40deg/0001.png").astype(float)
        - open_variant(dataset, "angles").view("extrapolating-40deg", 1).image
    )
    value = runs_by_angle["paper"]["extrapolating-40deg"]["psnr_db"]["pictures"][1]
    assert value == pytest.approx(10 * np.log10(255**2 / np.mean(error**2)))
    assert runs_by_angle["perfect"]["extrapolating-10deg"]["psnr_db"]["mean"] == "inf"

    scaled = scene["variants"]["x2"]
    assert scaled["runs"]["perfect"]["extrapolating"]["psnr_db"]["mean"] == "inf"
    assert set(scaled["runs"]) == {"paper", "perfect"}
    titles = ("mine: variant angles", "mine: variant x2", "mine: variant stereo-60mm")
    assert all(title in text for title in titles)
