"""Tests of Deferred Neural Rendering and of the paper's network on the first layer alone."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from support.reference import slow_convolution, slow_transposed_convolution
from support.synthetic import write_synthetic_dataset
from support.training import assert_resumes, build, configured, load

from datagen.data.config import Resolution
from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from model.batches.layers import load_pixels
from model.batches.rays import draw_patches
from model.methods.paper import dnr
from model.methods.paper.config import LEVEL_WEIGHTS, DnrConfig, DnrLayersConfig, MlpFirstConfig
from model.methods.paper.dnr import UNet
from model.methods.protocol import Inputs, open_inputs
from model.nets.pixel_mlp import spherical_harmonics
from model.run.run_folder import TrainConfig, read_run

pytestmark = pytest.mark.usefixtures("one_thread")


NET = DnrConfig(texture_size=24, position_size=64, unet_width=4, crop=32)
SMALL = TrainConfig(
    method="dnr", geometry=TRUTH, net=NET, steps=8, batch=2048, lr=0.003, evaluate_every=4, checkpoint_every=3
)


@pytest.mark.parametrize(
    ("inputs", "expected"), [(16, 16_671_107), (19, 16_674_179), (16 * 4, 16_720_259), (16 * 8, 16_785_795)]
)
def test_the_u_net_has_the_derived_number_of_parameters(inputs: int, expected: int) -> None:
    with torch.device("meta"):
        net = UNet(inputs)
    assert sum(parameter.numel() for parameter in net.parameters()) == expected


@pytest.mark.parametrize("norm", ["instance", "batch"])
def test_the_u_net_equals_slow_loops(norm: str) -> None:
    torch.manual_seed(0)
    net = UNet(3, width=2, norm=norm).eval()  # pyright: ignore[reportArgumentType]
    picture = torch.randn(1, 3, 32, 64)

    def weights(module: torch.nn.Module) -> tuple[np.ndarray, np.ndarray]:
        return (
            module.get_parameter("weight").detach().double().numpy(),
            module.get_parameter("bias").detach().double().numpy(),
        )

    skips, x = [], picture[0].double().numpy()
    for place, conv in enumerate(net.down):
        x = np.where(x > 0, x, 0.2 * x) if place else x
        x = slow_convolution(x, *weights(conv), stride=2, padding=1)
        skips.append(x)
    x = skips.pop()
    for conv in net.up:
        x = slow_transposed_convolution(np.maximum(x, 0), *weights(conv), stride=2, padding=1)
        x = (x - x.mean(axis=(1, 2), keepdims=True)) / np.sqrt(x.var(axis=(1, 2), keepdims=True) + 1e-5)
        x = np.concatenate([skips.pop(), x])
    expected = np.tanh(slow_transposed_convolution(np.maximum(x, 0), *weights(net.last), stride=2, padding=1))
    np.testing.assert_allclose(net(picture)[0].detach().numpy(), expected, atol=2e-5)


def test_a_picture_of_any_size_is_as_if_padded_with_zeros() -> None:
    torch.manual_seed(0)
    net = UNet(3, width=2)
    picture = torch.randn(1, 3, 40, 32)
    padded = torch.cat([picture, torch.zeros(1, 3, 24, 32)], dim=2)
    torch.testing.assert_close(net(picture), net(padded)[:, :, :40])


def test_patches_of_oblong_views_reach_every_border_and_leave_none(tmp_path: Path) -> None:
    views = write_synthetic_dataset(tmp_path, resolution=Resolution(width=24, height=16), train_views=2)
    pixels = load_pixels(views, TRUTH, "train", [0, 1], whole_views=True)
    index = draw_patches(pixels, 300, 5, np.random.default_rng(0), strides=(1, 3, 4)).numpy()
    view, place = np.divmod(index, 24 * 16)
    row, column = np.divmod(place, 24)
    assert set(view.flatten()) == {0, 1} and (view == view[:, :1, :1]).all()
    assert set(row[:, 1, 0] - row[:, 0, 0]) == {1, 3}  # 5 pixels four apart do not fit into 16.
    assert (np.ptp(column, axis=(1, 2)) == np.ptp(row, axis=(1, 2))).all()
    assert (row.min(), row.max(), column.min(), column.max()) == (0, 15, 0, 23)
    assert pixels.take(torch.arange(24 * 16), None).grid == (1, 16, 24)


def test_spherical_harmonics_multiply_nine_features_of_each_pixel(dataset: Dataset) -> None:
    config = dataclasses.replace(NET, texture_levels=1)
    renderer = dnr.build(config, Inputs(dataset=dataset, geometry=TRUTH, num_layers=2, layers_seal=""))
    torch.nn.init.normal_(renderer.textures[0].table, generator=torch.Generator().manual_seed(0))
    source = load_pixels(dataset, TRUTH, "train", [3], max_layers=2, whole_views=True)
    rays = source.take(torch.arange(1024), None)
    assert rays.grid == (1, 32, 32)
    seen = []
    renderer.net.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    renderer(rays)
    features = renderer.textures(rays.uv, rays.object_id)
    # The scene in closed form: pane at z = 0.5, floor at 0, uv = (x + 1, y + 1) / 2.
    height = torch.where(rays.object_id == 1, 0.5, 0.0)
    points = torch.cat([2 * rays.uv - 1, height[..., None]], dim=-1)
    view = torch.nn.functional.normalize(rays.p_camera[:, None] - points, dim=-1)
    for ray, layer in rays.object_id.nonzero()[::97].tolist():
        expected = features[ray, layer].clone()
        expected[3:12] *= spherical_harmonics(view[ray, layer])
        row, column = divmod(ray, 32)
        found = seen[0][0, 16 * layer : 16 * layer + 16, row, column]
        torch.testing.assert_close(found, expected, atol=0.05, rtol=0)  # A position texel is 3 cm wide.
    empty = (rays.object_id == 0).view(32, 32, 2)
    assert (seen[0][0].permute(1, 2, 0).view(32, 32, 2, 16)[empty] == 0).all()


def test_the_loss_is_the_sum_written_out(dataset: Dataset) -> None:
    renderer = build(NET, dataset)
    for seed, table in enumerate(renderer.textures.tables()):
        torch.nn.init.normal_(table, std=0.3, generator=torch.Generator().manual_seed(seed))
    source = load_pixels(dataset, TRUTH, "train", [0, 1, 2], max_layers=1, whole_views=True)
    loss = renderer.loss(source, 2048, np.random.default_rng(5))
    rng = np.random.default_rng(5)
    index = draw_patches(source, 2, 32, rng, strides=(1, 2)).flatten()
    rays = dataclasses.replace(source.take(index, None), grid=(2, 32, 32))
    truth = 2 * source.rgb[index].double() / 255 - 1
    expected = (2 * renderer(rays).double() - 1 - truth).abs().mean()
    features = renderer.textures(rays.uv, rays.object_id)[:, 0, :3].double()
    hit = rays.object_id[:, 0] > 0
    assert 0 < hit.sum() < len(hit)
    expected = expected + (features - truth)[hit].abs().mean()
    for weight, table in zip((8, 2, 1, 0), renderer.textures.tables()):
        expected = expected + 0.1 * weight * (table.double() ** 2).mean()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
    assert len(LEVEL_WEIGHTS) == 4
    loss.backward()
    touched = renderer.textures.tables()[3].grad
    assert touched is not None and touched.abs().sum() > 0


@pytest.mark.parametrize("method", ["dnr", "dnr-layers", "mlp-first"])
def test_a_stopped_and_resumed_run_has_the_same_bytes(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    small = {"dnr": NET, "dnr-layers": DnrLayersConfig(**vars(NET)), "mlp-first": MlpFirstConfig()}[method]
    inputs = open_inputs(small, dataset, TRUTH)
    assert inputs.num_layers == (4 if method == "dnr-layers" else 1)
    config = dataclasses.replace(SMALL, method=method, net=small.complete(inputs))
    assert_resumes(monkeypatch, config, dataset, tmp_path, stop=5)
    if method == "mlp-first":
        assert abs(read_run(tmp_path / "whole").num_parameters - 34_000) < 3000


def test_the_first_layer_alone_is_blind_to_what_lies_behind(dataset: Dataset) -> None:
    first = load(NET, dataset, [2]).take(torch.arange(1024), None)
    every = load(DnrLayersConfig(**vars(NET)), dataset, [2]).take(torch.arange(1024), None)
    assert first.object_id.shape == (1024, 1) and every.object_id.shape == (1024, 4)
    assert torch.equal(first.object_id[:, 0], every.object_id[:, 0])
    assert (every.object_id[:, 1] == 2).any()


def test_presets_and_impossible_choices(dataset: Dataset) -> None:
    mixed = configured(dataset, "dnr-authors", "--features", "16", "--extrinsics", "sh").net
    assert (mixed.texture_features, mixed.extrinsics, mixed.texture_levels) == (16, "sh", 1)
    with pytest.raises(HyalineError, match="features: is 8 with extrinsics sh; expected 12 to 256"):
        configured(dataset, "dnr", "--features", "8")
    with pytest.raises(HyalineError, match="crop: is 64; expected at most 32, the shorter side of pictures of 32 x 32"):
        configured(dataset, "dnr", "--crop", "64")
