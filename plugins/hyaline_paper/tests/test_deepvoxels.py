"""Tests of the method `deepvoxels`: its geometry, its networks, its loss, its run."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from support.commands import call
from support.reference import convolve, interpolate
from support.synthetic import look_at, write_synthetic_dataset
from support.training import assert_resumes

from datagen.data.cameras import Cameras, Lens
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
    grid_coordinates,
    lift,
    near_plane,
    sample_frustum,
)
from hyaline_paper.methods import DeepVoxelsConfig
from hyaline_paper.voxel_nets import Integration, Occlusion, collapse
from model.batches.rays import Views, load_views_of, views_of
from model.methods.protocol import open_inputs
from model.run.run_folder import TrainConfig, read_run
from model.run.train import train

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


def test_the_near_plane_never_comes_behind_the_camera() -> None:
    lens = Lens(fov_x=0.8, width=SIZE, height=SIZE)
    inside = lens.camera(look_at(np.array([0.4, 0, 0]), np.zeros(3)))
    assert float(near_plane(inside, some_grid())) == pytest.approx(0.15)


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


def test_the_cube_stands_where_cameras_look_and_holds_the_scene() -> None:
    vertices = np.random.default_rng(0).normal(size=(50, 3)) * 0.2 + [0.3, -0.2, 0.1]
    origin, edge = fit_cube(some_cameras(9), vertices)
    np.testing.assert_allclose(origin, [0.3, -0.2, 0.1], atol=1e-9)
    assert np.abs(vertices - origin).max() == pytest.approx(edge / 2)


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


def test_the_integration_is_the_gated_unit_of_its_formula() -> None:
    torch.manual_seed(0)
    unit = Integration(2).eval()
    new, old = torch.randn(1, 2, 4, 4, 4), torch.randn(1, 2, 4, 4, 4)
    result = unit(new, old, grid_coordinates(4))[0].detach().numpy()

    place = np.stack(np.meshgrid(*[[-0.5, -0.25, 0.0, 0.25]] * 3, indexing="ij"))
    h, x = np.concatenate([old[0].numpy(), place]), np.concatenate([new[0].numpy(), place])
    conv_x, conv_h, conv_rh = (part[1] for part in (unit.new, unit.old_gates, unit.old_candidate))

    def loops(volume: np.ndarray, layer: torch.nn.Module, channels: slice) -> np.ndarray:
        kernels = layer.get_parameter("weight").detach().numpy()[channels]
        has_bias = layer is conv_x
        biases = layer.get_parameter("bias").detach().numpy()[channels] if has_bias else np.zeros(len(kernels))
        return convolve(volume, kernels, biases)

    reset = 1 / (1 + np.exp(-loops(x, conv_x, slice(0, 1)) - loops(h, conv_h, slice(0, 1))))
    update = 1 / (1 + np.exp(-loops(x, conv_x, slice(1, 2)) - loops(h, conv_h, slice(1, 2))))
    candidate = np.tanh(loops(x, conv_x, slice(2, 4)) + loops(reset * h, conv_rh, slice(0, 2)))
    np.testing.assert_allclose(result, (1 - update) * old[0].numpy() + update * candidate, atol=1e-5)


def test_visibility_sums_to_one_and_features_are_its_mean_over_depth() -> None:
    torch.manual_seed(0)
    frustum = torch.randn(1, 3, 8, 16, 16)
    visibility = Occlusion(3, num_planes=8, plane_size=16)(frustum).detach()
    assert visibility.shape == (1, 1, 8, 16, 16) and (visibility >= 0).all()
    torch.testing.assert_close(visibility.sum(dim=2), torch.ones(1, 1, 16, 16))
    features = collapse(frustum, visibility)
    for row, column in ((0, 0), (5, 11)):
        total = sum(visibility[0, 0, d, row, column] * frustum[0, :, d, row, column] for d in range(8))
        torch.testing.assert_close(features[0, :, row, column], total / 8)


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


@pytest.mark.full
def test_it_learns_what_each_camera_sees(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic", train_views=4)
    net = dataclasses.replace(TINY, image_size=32, width=8, voxel_features=8)
    config = dataclasses.replace(run_config(net, steps=50), lr=0.004, lr_decay="linear", evaluate_every=25)
    train(config, dataset, tmp_path / "run", label="deepvoxels", device=CPU)
    losses = [json.loads(line)["loss"] for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    true = np.stack([dataset.view("train", view).image[5:-5, 5:-5] / 255 for view in range(4)])
    # The median is the best picture for a network that draws the same for every camera.
    same_for_all = np.abs(true - np.median(true, axis=0)).mean()
    assert losses[-1] < 0.8 * same_for_all


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
