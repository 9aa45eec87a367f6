"""Tests pictures that are not square, with a principal point aside, through every command from scene to report."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.commands import call, run
from support.synthetic import synthetic_scene

import hyaline
from datagen.data.cameras import look_at
from datagen.data.config import SPLITS, Resolution
from datagen.data.images import read_png
from datagen.data.transforms import TRANSFORMS_FILES
from datagen.scene.folder import save_scene

LENS = {"fl_x": 30, "fl_y": 30, "cx": 14, "cy": 22.5, "w": 48, "h": 32}
SIZE = "--preset tiny --resolution 24x16 --spp 64 --test-spp 64 --num-layers 4"


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scene/, data/oblong and runs/oblong, made by the commands."""
    root = tmp_path_factory.mktemp("oblong")
    save_scene(synthetic_scene(), root / "scene")
    places = {"train": 3, "interpolating": 1, "extrapolating": 1}
    data = json.loads((root / "scene" / "scene.json").read_text())
    del data["cameras"]
    (root / "scene" / "scene.json").write_text(json.dumps(data))
    for split, count in places.items():
        poses = [look_at((2.0 + 0.1 * place, place - 0.8, 1.5), (0.1, 0.3, 0.2)).tolist() for place in range(count)]
        listed = {**LENS, "frames": [{"transform_matrix": pose} for pose in poses]}
        (root / "scene" / TRANSFORMS_FILES[split]).write_text(json.dumps(listed))  # type: ignore[index]
    run(f"datagen build --scene '{root}/scene' --out '{root}/data/oblong' {SIZE}")
    return root


def test_all_that_is_built_has_its_shape_and_verifies(home: Path) -> None:
    run(f"datagen verify '{home}/data/oblong'")
    dataset = hyaline.open_dataset(home / "data/oblong")
    assert dataset.config.resolution == Resolution(width=24, height=16)
    assert dataset.num_views == {"train": 3, "interpolating": 1, "extrapolating": 1}
    for split in SPLITS:
        cameras = dataset.cameras(split)
        assert (cameras.width, cameras.height, cameras.center) == (24, 16, (7.0, 11.25))
        assert cameras[0].intrinsics[0, 0] == pytest.approx(15)
        for view in dataset.views(split):
            assert view.image.shape == (16, 24, 3) and view.layers().depth.shape == (4, 16, 24)
            assert cameras.near is not None and cameras.far is not None
            depth = view.layers().depth
            assert cameras.near < depth[depth > 0].min() and depth.max() < cameras.far


def test_what_the_truth_shows_is_where_the_layers_are(home: Path) -> None:
    """All light comes from an even sky, and the pane bends none: only pixels that show the floor are darker."""
    view = hyaline.open_dataset(home / "data/oblong").view("interpolating", 0)
    shows_floor = (view.object_ids() == 2).any(axis=0)
    is_dark = view.radiance.mean(axis=-1) < 0.45
    near_an_edge = np.zeros_like(shows_floor)
    for axis in (0, 1):
        changes = np.diff(shows_floor, axis=axis)
        end = changes.shape[axis]
        near_an_edge |= np.insert(changes, 0, False, axis=axis) | np.insert(changes, end, False, axis=axis)
    assert 0.1 < shows_floor.mean() < 0.9 and near_an_edge.mean() < 0.3
    assert np.array_equal(is_dark[~near_an_edge], shows_floor[~near_an_edge])


@pytest.mark.parametrize(
    "method", ["paper --batch 32 --hidden 8 --texture-size 8", "light-path --batch 32", "dnr --crop 16 --unet-width 4"]
)
def test_methods_train_on_it_and_predict_pictures_of_its_shape(home: Path, method: str) -> None:
    out = home / "runs/oblong" / method.split()[0]
    run(f"model train {method} --dataset '{home}/data/oblong' --out '{out}' --steps 2 --device cpu")
    for split in ("interpolating", "extrapolating"):
        assert read_png(out / "predictions" / split / "0000.png").shape == (16, 24, 3)


def test_listed_cameras_are_stored_once_and_build_the_same_dataset_again(home: Path) -> None:
    data = home / "data/oblong"
    assert "cameras" not in json.loads((data / "scene/scene.json").read_text())
    assert not list((data / "scene").glob("transforms*"))
    run(f"datagen build --scene '{data}/scene' --out '{home}/again' {SIZE}")
    for name in TRANSFORMS_FILES.values():
        if (data / name).is_file():
            assert (home / "again" / name).read_bytes() == (data / name).read_bytes()
    moved = json.loads((home / "scene/transforms_train.json").read_text())
    moved["frames"][0]["transform_matrix"][2][3] += 0.01
    (home / "scene/transforms_train.json").write_text(json.dumps(moved))
    answer = call(f"datagen build --scene '{home}/scene' --out '{data}' {SIZE}")
    assert answer.status == 1 and "transforms_train.json differs" in answer.error
