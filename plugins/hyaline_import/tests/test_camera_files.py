"""Tests that cameras of COLMAP, of NeRF tools and of glTF stand where they stood, and that broken ones are refused."""

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from support.gltf import BOX
from support.theirs import write_binary_model
from support.traced_dataset import write_traced_dataset

from datagen.data.cameras import look_at
from datagen.data.config import SPLITS
from datagen.data.dataset import open_dataset
from datagen.data.ply import write_ply
from datagen.data.transforms import lens_keys
from datagen.disk.errors import HyalineError
from datagen.scene.description import CameraList
from datagen.scene.finding import ImportChoices
from hyaline_export.formats import export_dataset
from hyaline_import.cameras import colmap_images, read_camera_file
from hyaline_import.importing import import_scene
from hyaline_import.remarks import Remarks


@pytest.fixture(scope="module")
def colmap(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, float]:
    """A folder of COLMAP's, and the cameras and the angle that it holds."""
    root = tmp_path_factory.mktemp("colmap")
    write_traced_dataset(root / "ours", resolution=16)
    dataset = open_dataset(root / "ours")
    export_dataset(dataset, "colmap", root / "theirs", num_points=20)
    write_binary_model(root / "theirs/sparse/0")
    splits = ("extrapolating", "interpolating", "train")  # As the names of the pictures are sorted.
    poses = np.concatenate([dataset.cameras(split).world_from_camera for split in splits])
    return root / "theirs", poses, dataset.cameras("train").fov_x


@pytest.mark.parametrize("left_out", ["bin", "txt"])
def test_colmaps_cameras_are_read_from_text_and_from_binary_files(
    colmap: tuple[Path, np.ndarray, float], tmp_path: Path, left_out: str
) -> None:
    theirs, poses, fov_x = colmap
    ending = {"bin": "txt", "txt": "bin"}[left_out]
    for name in ("cameras", "images"):
        source = next(theirs.rglob(f"{name}.{ending}"))
        (tmp_path / source.name).write_bytes(source.read_bytes())
    remarks = Remarks()
    found = read_camera_file(tmp_path, remarks)
    assert np.abs(np.stack([camera.world_from_camera for camera in found]) - poses).max() < 1e-6
    assert found[0].fov_x == pytest.approx(fov_x, rel=1e-9) and remarks.lines == []
    assert len(read_camera_file(theirs, Remarks())) == len(poses), "it is found where captures keep it, too"


CAMERA = "1 PINHOLE 100 80 120 120 50 40\n"
IMAGE = "1 1 0 0 0 0 0 5 1 a.png\n\n"


def write_text(root: Path, cameras: str, images: str) -> Path:
    (root / "cameras.txt").write_text(cameras)
    (root / "images.txt").write_text(images)
    return root


@pytest.mark.parametrize(
    ("cameras", "images", "message"),
    [
        ("1 OPENCV_FISHEYE 9 9 1 1 1 1 0 0 0 0\n", IMAGE, "of model 'OPENCV_FISHEYE'; expected one of SIMPLE_PINHOLE"),
        ("1 PINHOLE 100 80 120\n", IMAGE, "1 numbers of a PINHOLE"),
        ("1 PINHOLE 100 80 0 0 50 40\n", IMAGE, "a focal length of 0"),
        ("1 PINHOLE 100 80 nan nan 50 40\n", IMAGE, "a focal length of nan"),
        (CAMERA, "1 0 0 0 0 0 0 5 1 a.png\n\n", "a rotation of length 0"),
        (CAMERA, "1 1 0 0 0 0 0 5 7 a.png\n\n", "was taken by camera 7; expected one that cameras.txt has"),
        (CAMERA, "1 1 0 0\n\n", "its cameras or images are damaged"),
        (CAMERA, "", "has 0 images; expected 1 to 10,000"),
        (CAMERA, "# a comment\n", "has 0 images"),
    ],
)
def test_broken_text_of_colmap_is_refused(tmp_path: Path, cameras: str, images: str, message: str) -> None:
    with pytest.raises(HyalineError, match=message):
        read_camera_file(write_text(tmp_path, cameras, images), Remarks())


@pytest.mark.parametrize("points", ["\n", "", "10.5 20.25 -1 11.0 21.0 7\n"])
def test_text_of_colmap_may_lack_empty_lines_and_have_names_with_spaces(tmp_path: Path, points: str) -> None:
    images = "".join(f"{k} 1 0 0 0 {k} 0 5 1 picture  {k}.png\n{points}" for k in range(1, 5))
    found = colmap_images(write_text(tmp_path, CAMERA, f"# a comment\n{images}"))
    assert [*found] == [f"picture  {k}.png" for k in range(1, 5)]


def test_distorted_lenses_are_drawn_straight_and_said_to_be(tmp_path: Path) -> None:
    remarks = Remarks()
    (camera,) = read_camera_file(write_text(tmp_path, "1 OPENCV 100 80 120 121 44 41 0.1 0 0 0\n", IMAGE), remarks)
    assert [line.what for line in remarks.lines] == [
        "have a distorted lens; drawn as pinholes",
        "have pixels that are not square; drawn square, as wide as they are",
    ]
    assert (camera.focal, camera.center) == (pytest.approx(120), (44, 41))
    assert (camera.width, camera.height) == (100, 80)


def test_the_lens_of_a_transforms_file_keeps_its_principal_point_and_shape(tmp_path: Path) -> None:
    (tmp_path / "box.ply").write_bytes(write_ply(BOX))
    frames = [{"transform_matrix": look_at((2.0, place, 1.5), (0.0, 0.0, 0.0)).tolist()} for place in range(4)]
    lens = {"fl_x": 50, "fl_y": 50, "cx": 30, "cy": 14, "w": 64, "h": 48}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    choices = ImportChoices(cameras=str(tmp_path / "transforms.json"), material=("glass",), up="z")
    cameras = import_scene(tmp_path / "box.ply", choices).scene.cameras
    assert isinstance(cameras, CameraList)
    assert {key: lens_keys(cameras.train)[key] for key in lens} == pytest.approx(lens)
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "cx": 1e6, "frames": frames}))
    with pytest.raises(HyalineError, match=r"frames.0.: camera: its principal point is 1e\+06, 14"):
        import_scene(tmp_path / "box.ply", choices)


def test_a_binary_file_that_is_cut_anywhere_or_promises_too_much_is_refused(
    colmap: tuple[Path, np.ndarray, float], tmp_path: Path
) -> None:
    whole = {name: next(colmap[0].rglob(f"{name}.bin")).read_bytes() for name in ("cameras", "images")}
    for name, data in whole.items():
        spoilt = [data[:length] for length in (0, 3, 8, 20, 60, len(data) - 1)]
        spoilt += [struct.pack("<Q", count) for count in (1 << 63, 10_001)]
        for changed in spoilt:
            for other, content in {**whole, name: changed}.items():
                (tmp_path / f"{other}.bin").write_bytes(content)
            with pytest.raises(HyalineError, match=r"are damaged|has 0 images"):
                read_camera_file(tmp_path, Remarks())


def test_cameras_beside_a_model_move_with_it(tmp_path: Path) -> None:
    (tmp_path / "box.ply").write_bytes(write_ply(BOX))
    frames = []
    for place in range(10):
        angle = 2 * math.pi * place / 10
        back = np.array([math.cos(angle), 0.0, math.sin(angle)])  # Around +y, which is up in PLY files.
        matrix = np.eye(4)
        matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = (0, 1, 0), back, 3 * back
        matrix[:3, 0] = np.cross(matrix[:3, 1], back)
        frames.append({"file_path": f"{place}.png", "transform_matrix": matrix.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    choices = ImportChoices(cameras=str(tmp_path / "transforms.json"), material=("glass",), scale=0.5)
    scene = import_scene(tmp_path / "box.ply", choices).scene
    assert isinstance(scene.cameras, CameraList) and scene.cameras.train.fov_x == pytest.approx(0.6)
    poses = np.concatenate([scene.cameras.of(split).world_from_camera for split in SPLITS])
    assert len(poses) == 10
    box = next(item.mesh.vertices for item in scene.objects if item.name != "ground")
    middle = (box.min(axis=0) + box.max(axis=0)) / 2
    # All of them look at the box's middle, level, from 1.5 m away.
    np.testing.assert_allclose(poses[:, :3, 3] - 1.5 * poses[:, :3, 2], np.tile(middle, (10, 1)), atol=1e-5)
    np.testing.assert_allclose(poses[:, :3, 1], np.tile([0, 0, 1], (10, 1)), atol=1e-9)
