"""Tests of the renderer network and its extrinsic inputs."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y
from support.synthetic import pixel_rays, write_synthetic_dataset
from support.training import build
from torch import nn
from torch.nn import functional

from datagen.data.dataset import Dataset
from model.batches.layers import load_pixels
from model.batches.rays import insert_empty_layer, take_colors
from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer
from model.methods.protocol import open_inputs
from model.nets.pixel_mlp import (
    ExtrinsicInputs,
    Extrinsics,
    PixelMlp,
    bake_position_table,
    count_parameters,
    spherical_harmonics,
    width_for_34k,
)
from model.nets.texture import TexturePyramid
from model.settings import EXTRINSIC_CHANNELS, Norm


@pytest.mark.parametrize(
    ("width", "num_layers", "extrinsics", "without_norm", "with_norm"),
    [
        (256, 4, "view", 235_971, 238_723),
        (256, 16, "view", 294_339, 297_091),
        (80, 8, "view", 33_623, 34_483),
        (64, 16, "none", 30_195, 30_883),
        (64, 16, "view", 33_267, 33_955),
        (64, 16, "sh", 39_411, 40_099),
    ],
)
def test_the_network_has_the_derived_number_of_parameters(
    width: int, num_layers: int, extrinsics: Extrinsics, without_norm: int, with_norm: int
) -> None:
    inputs = num_layers * (16 + EXTRINSIC_CHANNELS[extrinsics])
    assert count_parameters(inputs, width, 3, "none") == without_norm
    assert count_parameters(inputs, width, 3, "batch") == with_norm
    if 33_000 < with_norm < 35_000:  # The published count.
        assert width_for_34k(inputs) == width


def test_spherical_harmonics_equal_scipy() -> None:
    direction = np.random.default_rng(0).normal(size=(50, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    theta, phi = np.arccos(direction[:, 2]), np.arctan2(direction[:, 1], direction[:, 0])

    def real(degree: int, order: int) -> np.ndarray:
        value = sph_harm_y(degree, abs(order), theta, phi) * (-1) ** order  # Without the Condon-Shortley phase.
        return value.real if order == 0 else np.sqrt(2) * (value.imag if order < 0 else value.real)

    orders = [(degree, order) for degree in range(3) for order in range(-degree, degree + 1)]
    expected = np.stack([real(*order) for order in orders], axis=1)
    np.testing.assert_allclose(spherical_harmonics(torch.from_numpy(direction).float()).numpy(), expected, atol=1e-6)


def test_view_vectors_point_back_along_the_pixels_rays(dataset: Dataset) -> None:
    pixels = load_pixels(dataset, "truth", "train", [3, 5])
    rays = pixels.take(torch.arange(len(pixels.rgb)), None)
    positions = bake_position_table(dataset, "truth", 128)
    assert bake_position_table(dataset, "truth", 128) is positions  # Training and predicting share it.
    view = ExtrinsicInputs("view", positions, num_objects=2, size=128)(rays.uv, rays.object_id, rays.p_camera)
    cameras = dataset.cameras("train")
    directions = np.concatenate([pixel_rays(cameras, index)[1].reshape(-1, 3) for index in (3, 5)])
    hit = rays.object_id != 0
    expected = torch.from_numpy(-directions)[:, None].expand(-1, 4, -1)
    # Half a texel at the border, 2 m / 128 / 2, seen from 2 m.
    assert (view[hit] - expected[hit]).norm(dim=-1).max() < 0.006
    assert hit.any() and (view[~hit] == 0).all()
    harmonics = ExtrinsicInputs("sh", positions, num_objects=2, size=128)(rays.uv, rays.object_id, rays.p_camera)
    assert harmonics.shape[-1] == 9 and (harmonics[~hit] == 0).all() and (harmonics[hit][:, 0] > 0.28).all()


def test_an_inserted_layer_is_empty_and_keeps_the_others_in_order(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data", num_layers=3)
    rays = load_pixels(dataset, "truth", "train", [0]).take(torch.arange(400, 404), None)
    more = insert_empty_layer(rays, np.random.default_rng(0))
    place = np.random.default_rng(0).integers(4, size=4)
    assert len(set(place)) > 2
    for ray in range(4):
        kept = [layer for layer in range(4) if layer != int(place[ray])]
        assert more.object_id[ray, place[ray]] == 0
        assert torch.equal(more.object_id[ray, kept], rays.object_id[ray])
        assert torch.equal(more.uv[ray, kept], rays.uv[ray])


def test_the_zero_layer_comes_last_at_test_and_anywhere_in_training(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data", num_layers=3)
    rays = load_pixels(dataset, "truth", "train", [0]).take(torch.arange(1024), None)
    config = PaperConfig(width=16, extrinsics="none", texture_size=16, zero_layer=True)
    renderer = PaperRenderer(config, num_layers=3, num_objects=2, positions=None).eval()
    torch.nn.init.normal_(renderer.textures.table)  # Fresh ones are the same everywhere.
    assert renderer.net.first.linear.in_features == 4 * 16
    stack = torch.cat([renderer.textures(rays.uv, rays.object_id).flatten(1), torch.zeros(1024, 16)], dim=1)
    torch.testing.assert_close(renderer(rays), renderer.net(stack))
    moved = renderer(rays, rng=np.random.default_rng(0))
    assert not torch.allclose(moved, renderer(rays))
    assert torch.equal(moved, renderer(rays, rng=np.random.default_rng(0)))


@pytest.mark.parametrize("levels", [1, 3])
def test_textures_start_at_zero_but_at_one_half_where_the_network_sees_nothing_else(
    tmp_path: Path, levels: int
) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data", num_layers=2)
    rays = load_pixels(dataset, "truth", "train", [0]).take(torch.arange(1024), None)
    hit = rays.object_id != 0
    alone = PaperConfig(width=16, extrinsics="none", texture_size=16, texture_levels=levels, position_size=8)
    for config, start in ((alone, 0.5), (dataclasses.replace(alone, extrinsics="view"), 0.0)):
        features = build(config, dataset).textures(rays.uv, rays.object_id)
        torch.testing.assert_close(features, start * hit[..., None].float().expand_as(features))


def test_the_papers_textures_can_be_a_pyramid_whose_finer_levels_count_less(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data", num_layers=2)
    net = PaperConfig(extrinsics="none", texture_size=16, texture_levels=3, texture_features=64, finer_counts=0.5)
    inputs = open_inputs(net, dataset, "truth")
    config = net.complete(inputs)
    assert dataclasses.replace(net, blocks=1).complete(inputs).width == config.width
    renderer = build(config, dataset).eval()
    assert isinstance(renderer.textures, TexturePyramid)
    assert renderer.net.first.linear.in_features == 2 * 64
    assert abs(count_parameters(128, config.width, 3) - 34_000) < 2000
    texels = [table.shape[0] for table in renderer.textures.tables()]
    assert texels == [512, 128, 32]
    rays = load_pixels(dataset, "truth", "train", [0]).take(torch.arange(1024), None)
    with torch.no_grad():
        for level, table in enumerate(renderer.textures.tables()):
            table.fill_(10.0**level)
    seen = []
    renderer.net.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    renderer(rays)
    expected = (100 + 10 / 2 + 1 / 4) * (rays.object_id != 0).repeat_interleave(64, dim=1)
    torch.testing.assert_close(seen[0], expected)


def test_stored_uv_and_colors_come_back_exactly(dataset: Dataset) -> None:
    pixels = load_pixels(dataset, "truth", "train", [1, 6])
    row, column = 20, 9
    index = torch.tensor([1024 + row * 32 + column])  # In the second of the two views.
    layers = dataset.view("train", 6).layers("truth")
    rays = pixels.take(index, None)
    np.testing.assert_array_equal(rays.object_id[0].numpy(), layers.object_id[:, row, column])
    np.testing.assert_allclose(rays.uv[0].numpy(), layers.uv[:, row, column] / 65535, atol=1e-7)
    expected = dataset.view("train", 6).image[row, column] / 255
    np.testing.assert_allclose(take_colors(pixels, index)[0].numpy(), expected, atol=1e-7)
    position = dataset.cameras("train").world_from_camera[6, :3, 3]
    np.testing.assert_allclose(rays.p_camera[0].numpy(), position, rtol=1e-6)


def trained_net(norm: Norm) -> tuple[PixelMlp, torch.Tensor]:
    """A network whose batch norm has seen a few batches, and inputs."""
    torch.manual_seed(0)
    net = PixelMlp(40, width=32, blocks=3, norm=norm)
    with torch.no_grad():
        for module in net.modules():
            if isinstance(module, nn.BatchNorm1d):
                module.weight.uniform_(0.5, 1.5)
                module.bias.normal_(std=0.3)
        for _ in range(20):
            net(2 * torch.randn(500, 40) + 0.5)
    return net.eval(), 2 * torch.randn(1000, 40) + 0.5


@pytest.mark.parametrize("norm", ["batch", "none"])
def test_layers_with_folded_norms_compute_what_the_network_does_at_evaluation(norm: Norm) -> None:
    net, x = trained_net(norm)

    def unit(x: torch.Tensor, layer: int) -> torch.Tensor:
        return functional.leaky_relu(functional.linear(x, *layers[layer]), 0.2)

    with torch.inference_mode():
        layers = net.folded()
        hidden = unit(x, 0)
        for first in range(1, len(layers) - 1, 3):
            hidden = unit(hidden + unit(unit(hidden, first), first + 1), first + 2)
        found, expected = functional.linear(hidden, *layers[-1]), net(x)
    assert (found - expected).abs().max() / expected.abs().max() < 1e-5
