"""Tests of what the released code ran."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from support.training import assert_resumes, build

from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from hyaline_paper.authors_code import AuthorsMlp, AuthorsRenderer, harmonics_without_constants
from hyaline_paper.methods import AuthorsConfig
from model.batches.layers import load_pixels
from model.nets.pixel_mlp import Extrinsics, spherical_harmonics
from model.run.predict import predict_pixels
from model.run.run_folder import TrainConfig

pytestmark = pytest.mark.usefixtures("one_thread")


CPU = torch.device("cpu")
NET = AuthorsConfig(texture_size=24, position_size=64)
SMALL = TrainConfig(
    method="authors-code",
    geometry=TRUTH,
    net=NET,
    steps=10,
    batch=256,
    beta1=0.5,
    weight_decay=1e-4,
    evaluate_every=5,
    checkpoint_every=4,
)


@pytest.mark.parametrize(
    ("extrinsics", "num_layers", "expected"),
    [
        ("view", 16, 33_267),
        ("view", 17, 34_483),
        ("sh", 16, 39_411),
        ("none", 16, 30_195),
    ],
)
def test_the_network_has_the_derived_number_of_parameters(
    extrinsics: Extrinsics, num_layers: int, expected: int
) -> None:
    config = AuthorsConfig(texture_size=2, position_size=2, extrinsics=extrinsics)
    positions = None if extrinsics == "none" else torch.zeros(4, 3)
    renderer = AuthorsRenderer(config, num_layers=num_layers, num_objects=1, positions=positions)
    assert sum(parameter.numel() for parameter in renderer.net.parameters()) == expected


def test_the_network_equals_its_formula_written_out() -> None:
    torch.manual_seed(0)
    net = AuthorsMlp(10, width=8, blocks=2)
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter)
    layers = [module for module in net.modules() if isinstance(module, torch.nn.Linear)]
    assert [layer.out_features for layer in layers] == [8, 8, 8, 4, 4, 4, 4, 3]  # Never below 4.
    x = torch.randn(5, 10)
    y = x.double().numpy()

    def linear(values: np.ndarray, place: int) -> np.ndarray:
        return values @ layers[place].weight.detach().double().numpy().T + layers[place].bias.detach().numpy()

    y = linear(y, 0)
    for first in (1, 4):
        y = np.maximum(y + linear(np.maximum(linear(y, first), 0), first + 1), 0)
        y = np.maximum(linear(y, first + 2), 0)
    np.testing.assert_allclose(net(x, 0.0).detach().numpy(), np.tanh(linear(y, 7)), atol=1e-5)


def test_harmonics_differ_from_the_real_ones_by_constants_only() -> None:
    direction = torch.nn.functional.normalize(torch.randn(40, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    ratio = spherical_harmonics(direction) / harmonics_without_constants(direction)
    assert torch.allclose(ratio, ratio[:1], atol=1e-4)


def test_the_basis_multiplies_nine_channels_and_the_rest_is_as_stored(dataset: Dataset) -> None:
    config = dataclasses.replace(NET, extrinsics="sh")
    renderer = build(config, dataset)
    rays = load_pixels(dataset, TRUTH, "train", [2]).take(torch.arange(1024), None)
    seen = []
    renderer.net.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    renderer(rays)
    stack = seen[0].view(1024, 4, 25)
    hit = rays.object_id != 0
    assert (stack[~hit] == 0).all()
    # Every texel starts at one half, so only the basis is left to see.
    still = torch.cat([stack[hit][:, :4], stack[hit][:, 12:]], dim=1)
    assert (still - 0.5).abs().max() < 1e-6
    away = 2 * stack[hit][:, [6, 4, 5]]  # x; y, z.
    assert torch.allclose(away.norm(dim=-1), torch.ones(len(away)), atol=1e-4)
    height = torch.where(rays.object_id == 1, 0.5, 0.0)
    points = torch.cat([2 * rays.uv - 1, height[..., None]], dim=-1)
    expected = torch.nn.functional.normalize(points - rays.p_camera[:, None], dim=-1)[hit]
    assert (away - expected).abs().max() < 0.03  # Of a position texture of 64 texels.
    assert torch.allclose(2 * stack[hit][:, 9], 3 * away[:, 2] ** 2 - 1, atol=1e-4)


def test_dropout_stays_on_at_test_and_repeats(dataset: Dataset) -> None:
    torch.manual_seed(0)
    renderer = build(NET, dataset)
    for parameter in renderer.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    pixels = load_pixels(dataset, TRUTH, "interpolating", [0, 1])
    before = torch.get_rng_state()
    noisy = predict_pixels(renderer, pixels)
    assert torch.equal(torch.get_rng_state(), before)
    assert np.array_equal(noisy, predict_pixels(renderer, pixels))
    quiet = build(dataclasses.replace(NET, dropout=0.0), dataset)
    quiet.load_state_dict(renderer.state_dict())
    assert not np.array_equal(noisy, predict_pixels(quiet, pixels))
    # Of 20,000 hidden units a fifth is silent, and what is left is scaled up.
    torch.manual_seed(1)
    kept = torch.nn.functional.dropout(torch.ones(20_000), NET.dropout)
    assert 0.78 < (kept > 0).float().mean() < 0.82 and kept.max() == 1.25


def test_it_learns_resumes_to_the_bit_and_predicts_the_same_twice(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert_resumes(monkeypatch, SMALL, dataset, tmp_path, stop=6)
