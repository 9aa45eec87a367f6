"""Tests that cameras of COLMAP stand where they stood, and that broken ones are refused."""

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from support.theirs import write_binary_model
from support.traced_dataset import write_traced_dataset

from datagen.data.dataset import open_dataset
from datagen.disk.errors import HyalineError
from hyaline_export.formats import export_dataset
from hyaline_import.cameras import colmap_images


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
    found = [*colmap_images(tmp_path).values()]
    assert np.abs(np.stack([pose for _, pose, _ in found]) - poses).max() < 1e-6
    row = found[0][0]
    assert 2 * math.atan(row.width / 2 / row.values[0]) == pytest.approx(fov_x, rel=1e-9)
    assert len(colmap_images(theirs)) == len(poses), "it is found where captures keep it, too"


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
        (CAMERA, IMAGE.strip() + "\n" + IMAGE, "an image is not followed by a line of its points"),
        (CAMERA, "", "has 0 images; expected 1 to 10,000"),
        (CAMERA, "# a comment\n", "has 0 images"),
    ],
)
def test_broken_text_of_colmap_is_refused(tmp_path: Path, cameras: str, images: str, message: str) -> None:
    with pytest.raises(HyalineError, match=message):
        colmap_images(write_text(tmp_path, cameras, images))


@pytest.mark.parametrize("points", ["\n", "10.5 20.25 -1 11.0 21.0 7\n"])
def test_text_of_colmap_may_have_names_with_spaces(tmp_path: Path, points: str) -> None:
    images = "".join(f"{k} 1 0 0 0 {k} 0 5 1 picture  {k}.png\n{points}" for k in range(1, 5))
    found = colmap_images(write_text(tmp_path, CAMERA, f"# a comment\n{images}"))
    assert [*found] == [f"picture  {k}.png" for k in range(1, 5)]


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
                colmap_images(tmp_path)
