"""Tests of the method `deepvoxels`: its geometry, its networks, its loss, its run."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from support.commands import call
from support.reference import interpolate
from support.synthetic import look_at, write_synthetic_dataset
from support.training import assert_resumes

from datagen.data.cameras import Cameras
from datagen.data.config import square
from datagen.data.dataset import Dataset
from datagen.data.images import read_png
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from hyaline_paper.deepvoxels import (
    DeepVoxels,
    VoxelGrid,
    build,
    fit_cube,
    frustum_points,
    lift,
    sample_frustum,
)
from hyaline_paper.methods import DeepVoxelsConfig
from model.batches.rays import Views, load_views_of, views_of
from model.methods.protocol import open_inputs
from model.run.run_folder import TrainConfig, read_run

CPU = torch.device("cpu")
SIZE = 16
TINY = DeepVoxelsConfig(image_size=64, plane_size=16, num_voxels=8, voxel_features=3, width=2)


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("deepvoxels") / "data" / "synthetic"
    return write_synthetic_dataset(root, resolution=64, train_views=5)


def some_cameras(count: int, *, target: tuple[float, float, float] = (0.3, -0.2, 0.1), radius: float = 2.0) -> Cameras:
    rng = np.random.default_rng(count)
    way = rng.normal(size=(count, 3)) * [1, 1, 0.5]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    poses = [look_at(np.array(target) + radius * direction, np.array(target)) for direction in way]
    return Cameras(world_from_camera=np.stack(poses), fov_x=np.radians(50), width=SIZE, height=SIZE)


def some_grid(num_voxels: int = 8, edge: float = 1.2) -> VoxelGrid:
    origin = torch.tensor([0.3, -0.2, 0.1])
    return VoxelGrid(origin=origin, voxel_size=torch.tensor(edge / num_voxels), num_voxels=num_voxels)


# Geometry


def test_a_frustum_lies_on_the_pixels_rays_a_voxel_apart_around_the_grid() -> None:
    cameras, grid = some_cameras(4), some_grid()
    for view in range(4):
        camera = cameras[view]
        points = frustum_points(camera, grid, SIZE).reshape(grid.num_planes, SIZE, SIZE, 3).numpy()
        origin, directions = cameras[view].rays()
        forward = -cameras.world_from_camera[view, :3, 2]
        # The cameras stand 2 metres off: the grid's bounding sphere begins there but for half its diagonal.
        depth = 2 - 0.6 * np.sqrt(3) + 0.15 * np.arange(grid.num_planes)
        expected = origin + depth[:, None, None, None] * (directions / (directions @ forward)[..., None])
        np.testing.assert_allclose(points, expected, atol=2e-5)
        assert depth[-1] > 2 + 0.6 * np.sqrt(3)


def test_lifting_equals_a_loop_and_leaves_unseen_voxels_empty() -> None:
    # So large and so near that some voxels are behind the camera, some beside the picture.
    cameras, grid = some_cameras(2, radius=0.7), some_grid(edge=3.0)
    features = torch.rand(1, 3, SIZE, SIZE) + 1
    for view in range(2):
        lifted = lift(features, cameras[view], grid)[0].numpy()
        table = features[0].permute(1, 2, 0).numpy()
        camera_from_world = np.linalg.inv(cameras.world_from_camera[view])
        focal = 0.5 * SIZE / np.tan(cameras.fov_x / 2)
        seen = 0
        for z, y, x in np.ndindex(8, 8, 8):
            p_world = grid.origin.numpy() + 3.0 / 8 * (np.array([x, y, z]) - 4)
            right, up, back, _ = camera_from_world @ [*p_world, 1]
            row, column = SIZE / 2 + focal * up / back, SIZE / 2 - focal * right / back
            is_seen = back < 0 and 0 <= row < SIZE and 0 <= column < SIZE
            place = np.clip([row - 0.5, column - 0.5], 0, SIZE - 1)
            expected = interpolate(table, place) if is_seen else np.zeros(3)
            np.testing.assert_allclose(lifted[:, z, y, x], expected, atol=1e-4)
            seen += is_seen
        assert 20 < seen < 400


def test_projecting_equals_a_loop_and_has_a_gradient() -> None:
    cameras, grid = some_cameras(1), some_grid(num_voxels=4)
    volume = torch.rand(1, 2, 4, 4, 4, requires_grad=True)
    camera = cameras[0]
    sampled = sample_frustum(volume, camera, grid, 8)
    points = frustum_points(camera, grid, 8).numpy()
    table = volume.detach()[0].permute(1, 2, 3, 0).numpy()
    expected = np.zeros((len(points), 2))
    for index, point in enumerate(points):
        x, y, z = (point - grid.origin.numpy()) / 0.3 + 2
        if min(x, y, z) >= 0 and max(x, y, z) <= 3:
            expected[index] = interpolate(table, np.array([z, y, x]))
    assert 20 < (expected[:, 0] > 0).sum() < len(expected)
    np.testing.assert_allclose(sampled.detach()[0].flatten(1).T, expected, atol=1e-4)
    # The weights of a point inside sum to 1, so each hands on all of its gradient.
    sampled.sum().backward()
    assert volume.grad is not None
    assert float(volume.grad.sum()) == pytest.approx(2 * (expected[:, 0] > 0).sum(), rel=1e-4)


def test_neighbours_are_the_nearest_in_angle_and_never_the_view_itself() -> None:
    cameras = some_cameras(12)
    views = Views(rgb=torch.zeros(0, 3, dtype=torch.uint8), cameras=cameras)
    for view in range(12):
        forward = cameras.world_from_camera[:, :3, 2]
        angles = [np.arccos(np.clip(forward[view] @ other, -1, 1)) for other in forward]
        assert views.neighbours(view) == sorted(set(range(12)) - {view}, key=lambda other: angles[other])[:4]


# Networks


@pytest.mark.parametrize(
    ("size", "width", "features", "parts"),
    [
        # Source: the authors' modules, counted by arithmetic.
        (128, 64, 64, (57_709_120, 238_854, 4_007_872, 219_824, 75_351_715)),
        (128, 16, 32, (3_614_640, 64_294, 1_003_488, 216_368, 4_717_867)),
    ],
)
def test_every_part_has_its_authors_number_of_parameters(
    size: int, width: int, features: int, parts: tuple[int, ...]
) -> None:
    with torch.device("meta"):
        config = DeepVoxelsConfig(image_size=size, plane_size=64, width=width, voxel_features=features)
        net = DeepVoxels(config, origin=torch.zeros(3), edge=1.0)
    modules = (net.feature_extractor, net.integration, net.inpainting, net.occlusion, net.rendering)
    assert tuple(sum(p.numel() for p in module.parameters()) for module in modules) == parts
    total = {(128, 64): 137.5, (128, 16): 9.6}[size, width]
    assert round(sum(parts) / 1e6, 1) == total == round(sum(p.numel() for p in net.parameters()) / 1e6, 1)


def test_drawing_leaves_the_grid_and_observing_keeps_it_without_gradient(dataset: Dataset) -> None:
    net = build(TINY, open_inputs(TINY, dataset, TRUTH))
    views = load_views_of(views_of, dataset, "train", [0, 1, 2], with_images=True)
    net.observe(views.image(0), views.cameras[0])
    kept = net.get_buffer("volume").clone()
    assert kept.abs().sum() > 0 and not net.get_buffer("volume").requires_grad
    net.eval()
    both = net(views.take(torch.arange(64 * 64, 3 * 64 * 64), None))
    assert both.shape == (2 * 64 * 64, 3) and ((both >= 0) & (both <= 1)).all()
    torch.testing.assert_close(both[64 * 64 :], net(views.take(torch.arange(2 * 64 * 64, 3 * 64 * 64), None)))
    assert torch.equal(net.get_buffer("volume"), kept)


# The run


def run_config(net: DeepVoxelsConfig, *, steps: int) -> TrainConfig:
    return TrainConfig(
        method="deepvoxels",
        geometry="truth",
        net=net,
        steps=steps,
        batch=2,
        lr=4e-4,
        lr_decay="none",
        evaluate_every=2,
        checkpoint_every=2,
    )


def test_a_stopped_and_resumed_run_has_the_same_bytes(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = run_config(TINY, steps=5)
    assert_resumes(monkeypatch, config, dataset, tmp_path, stop=3)
    record = read_run(tmp_path / "whole")
    assert (record.geometry, record.knowledge) == ("none", "cameras only, and the scene's extent")


def test_the_command_trains_the_small_preset_on_a_cpu(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic")
    out = tmp_path / "run"
    answer = call(f"model train deepvoxels {dataset.root} --out {out} --steps 1 --device cpu")
    assert answer.status == 0 and "no layers" in answer.err
    run = json.loads((out / "run.json").read_text())
    assert run["config"]["lr"] == 2e-3 and run["config"]["batch"] == 2
    assert (run["config"]["net"]["width"], run["config"]["net"]["plane_size"]) == (16, 16)
    assert read_png(out / "predictions/extrapolating/0001.png").shape == (32, 32, 3)
    answer = call(f"model predict {out} --variant remove:pane")
    assert "method deepvoxels uses no geometry, so it cannot draw an edit" in answer.err
    answer = call(f"model train deepvoxels {dataset.root} --out {tmp_path / 'other'} --geometry box")
    assert answer.status == 1 and "method deepvoxels uses no geometry; leave it out" in answer.err


def test_what_it_cannot_learn_from_is_refused(dataset: Dataset) -> None:
    cameras = some_cameras(1)
    same = dataclasses.replace(cameras, world_from_camera=np.repeat(cameras.world_from_camera, 3, axis=0))
    large = dataclasses.replace(TINY, image_size=128)
    refused = {
        "look the same way; deepvoxels needs views from around": lambda: fit_cube(same, np.zeros((1, 3))),
        "is 64 x 64; deepvoxels draws 128 x 128": lambda: large.load(
            open_inputs(TINY, dataset, TRUTH), "train", [0], with_images=False
        ),
        "is 100 x 100; .* so build the dataset with --resolution 128": lambda: TINY.sized(square(100)),
        "is 8 x 8; .* so build the dataset with --resolution 16": lambda: TINY.sized(square(8)),
    }
    for message, call_it in refused.items():
        with pytest.raises(HyalineError, match=message):
            call_it()
