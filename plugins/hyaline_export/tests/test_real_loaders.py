"""Tests that the tools' own loaders read an export as the dataset is.

`HYALINE_PEERS=/path/to/python pytest plugins/hyaline_export/tests/test_real_loaders.py` opens every export with the
loaders that this interpreter can import (`loaders_child.py`); it needs no hyaline.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.traced_dataset import write_traced_dataset

from datagen.data.dataset import Dataset
from hyaline_export.formats import export_dataset
from hyaline_export.source import Source

CHILD = Path(__file__).with_name("loaders_child.py")

REAL = (
    ("nerfstudio-data", "nerfstudio"),
    ("nerfstudio-blender", "blender"),
    ("nerfstudio-blender", "3dgs"),
    ("nerfstudio-colmap", "colmap"),
    ("pycolmap", "colmap"),
    ("datasets", "huggingface"),
)
"""Loaders, and the formats that they open."""

NUM_POINTS, NUM_PLACES, NOT_INSTALLED = 200, 32, 3


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_traced_dataset(tmp_path_factory.mktemp("source") / "glasses")


@pytest.mark.skipif("HYALINE_PEERS" not in os.environ, reason="HYALINE_PEERS names no interpreter that has other tools")
@pytest.mark.parametrize("loader, form", REAL)
def test_the_real_loader_reads_the_export_rightly(loader: str, form: str, dataset: Dataset, tmp_path: Path) -> None:
    check_loader(Path(os.environ["HYALINE_PEERS"]), loader, form, dataset, tmp_path)


def check_loader(python: Path, loader: str, form: str, dataset: Dataset, folder: Path) -> None:
    """Exports, asks the loader, and compares names, pictures, rays, depth, points and planes with the dataset."""
    export_dataset(dataset, form, folder / "export", num_points=NUM_POINTS)
    source = Source(dataset=dataset, num_points=NUM_POINTS)
    rng = np.random.default_rng(0)
    places = {
        item.name: rng.uniform(0, [item.view.camera.width, item.view.camera.height], (NUM_PLACES, 2))
        for item in source.views
    }
    question, answer = folder / "question.npz", folder / "answer.npz"
    np.savez(question, **places)  # pyright: ignore[reportArgumentType]
    # The interpreter of a virtual environment is a link that must not be resolved: its path selects the packages.
    command = [python.absolute(), "-I", CHILD, loader, folder / "export", question, answer]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, cwd=folder, check=False)
    if done.returncode == NOT_INSTALLED:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr
    with np.load(answer) as file:
        read = dict(file.items())
    about = json.loads(str(read["about"]))
    listed = {split: sorted(names) for split, names in about["splits"].items()}
    assert listed == {role: sorted(item.name for item in source.of_role(role)) for role in listed}
    views = {item.name: item for item in source.views}
    has_validation = "val" in listed or not listed
    assert set(about["names"]) == {name for name, item in views.items() if has_validation or item.role != "val"}
    for name in about["names"]:
        camera, colors = views[name].view.camera, read[f"{name}/colors"]
        assert np.array_equal(colors[..., :3], views[name].view.image) and (colors[..., 3:] == 255).all()
        matrix, lens = camera.world_from_camera, camera.intrinsics
        x, y = ((places[name] - lens[:2, 2]) / lens[[0, 1], [0, 1]]).T
        expected = np.stack([x, -y, -np.ones_like(x)], axis=-1) @ matrix[:3, :3].T
        expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
        directions = read[f"{name}/directions"]
        directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        # Loaders use single precision; the errors to detect are half a pixel.
        assert np.abs(directions - expected).max() * lens[0, 0] < 0.05
        assert np.abs(read[f"{name}/origins"] - matrix[:3, 3]).max() < 1e-5
        if f"{name}/depth" in read:  # PNGs have whole millimetres.
            assert np.abs(read[f"{name}/depth"] - views[name].quantities.depth_along_axis).max() < 0.0006
    if "points" in read:
        assert np.abs(read["points"] - source.points.position).max() < 1e-5
        # A loader that goes through fractions may round down by one.
        assert np.abs(read["colors"].astype(int) - source.points.color).max() <= 1
    if about["near_far"] is not None:
        assert tuple(about["near_far"]) == (*source.near_far.values(),)
