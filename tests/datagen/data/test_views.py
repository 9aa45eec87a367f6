"""Tests that a dataset is opened once, and that a view reads its own files, each of them verified."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import write_synthetic_dataset

from datagen.data.cameras import Camera
from datagen.data.config import MAX_SIDE, parse_resolution
from datagen.data.dataset import Dataset, open_dataset
from datagen.disk.errors import DamagedError, HyalineError

OPENED: list[str] = []


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    write_synthetic_dataset(tmp_path_factory.mktemp("views") / "table")
    sys.addaudithook(lambda event, arguments: OPENED.append(str(arguments[0])) if event == "open" else None)
    return open_dataset(next((tmp_path_factory.getbasetemp()).glob("views*/table")))


def opened_by(root: Path, read: object) -> list[str]:
    OPENED.clear()
    read()  # type: ignore[operator]
    return sorted(path.removeprefix(f"{root}/") for path in OPENED if path.startswith(str(root)))


def test_a_view_opens_its_own_files_alone(dataset: Dataset) -> None:
    dataset.view("train", 0).layers()
    assert dataset.view("train", 0).camera.width == dataset.config.resolution.width
    view = dataset.view("train", 1)
    arrays = [f"layers/straight/arrays/train/0001.{name}.npy.blosc" for name in ("depth", "object_id", "uv")]
    record = "layers/straight/records/train/0001.json"
    assert opened_by(dataset.root, view.layers) == [*arrays, record]
    assert opened_by(dataset.root, view.object_ids) == [arrays[1], record]
    assert opened_by(dataset.root, lambda: view.camera) == []
    assert opened_by(dataset.root, lambda: view.image) == ["images/train/0001.png", "records/train/0001.json"]


@pytest.mark.parametrize(
    "broken",
    [
        *("layers/straight/layers.json", "layers/straight/arrays/train/0000.uv.npy.blosc"),
        *("transforms_train.json", "images/train/0000.exr", "dataset.json"),
    ],
)
def test_a_file_that_is_damaged_is_refused_by_whoever_opens_it_next(
    broken: str, dataset: Dataset, tmp_path: Path
) -> None:
    def read(copy: Dataset) -> None:
        view = copy.view("train", 0)
        _ = view.layers(), view.radiance, view.camera

    root = shutil.copytree(dataset.root, tmp_path / "copy")
    here = open_dataset(root)
    read(here)
    data = bytearray((root / broken).read_bytes())
    data[len(data) // 2] ^= 4
    (root / broken).write_bytes(data)
    with pytest.raises(DamagedError):
        read(open_dataset(root))
    if broken != "dataset.json":
        with pytest.raises(DamagedError):
            read(here)


@pytest.mark.parametrize("center", [None, (1.25, 4.5), (-3.0, 8.0)])
def test_intrinsics_project_a_pixels_ray_onto_its_centre(center: tuple[float, float] | None) -> None:
    pose = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    pose = np.block([[pose * np.sign(np.linalg.det(pose)), np.array([[1.0], [2.0], [3.0]])], [np.eye(4)[3:]]])
    camera = Camera(world_from_camera=pose, fov_x=0.9, width=7, height=5, center=center)
    origin, directions = camera.rays()
    assert np.allclose(origin, [1, 2, 3]) and np.allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)
    d_camera = directions @ pose[:3, :3] * [1, -1, -1]  # In OpenCV's camera, which looks along +z with y down.
    pixels = d_camera @ camera.intrinsics.T
    pixels = pixels[..., :2] / pixels[..., 2:]
    assert np.allclose(pixels[3, 2], [2.5, 3.5], atol=1e-5) and np.allclose(pixels[0, 6], [6.5, 0.5], atol=1e-5)
    projected, depth = camera.project((origin + 3 * directions).reshape(-1, 3).astype(np.float64))
    rows, columns = np.mgrid[:5, :7] + 0.5
    assert np.allclose(projected, np.stack([columns, rows], axis=-1).reshape(-1, 2), atol=1e-4) and (depth > 0).all()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("-3", "is -3; expected 1 to 8192"),
        (f"20x{MAX_SIDE + 1}", "is 8193; expected 1 to 8192"),
        ("32x", "is '32x'; expected a width and height"),
        ("3.5", "is '3.5'; expected a width and height"),
        ("٣٢", "expected a width and height"),
        ("9" * 5000, "expected a width and height"),
    ],
)
def test_what_is_no_size_of_pictures_is_refused_in_one_line(text: str, problem: str) -> None:
    with pytest.raises(HyalineError, match=f"^resolution: .*{problem}") as caught:
        parse_resolution(text)
    assert len(str(caught.value)) < 200 and "\n" not in str(caught.value)
