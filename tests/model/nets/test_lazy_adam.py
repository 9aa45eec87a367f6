"""Tests Adam for large textures against torch's dense Adam."""

import math

import numpy as np
import pytest
import torch

from datagen.disk.errors import HyalineError
from model.methods.renderer import ParameterGroup
from model.nets.texture import NeuralTextures, object_layout
from model.run.optimizer import Optimizer, make_optimizer

UPDATES = 600

pytestmark = pytest.mark.usefixtures("one_thread")


def rate(update: int) -> float:
    return 0.04 * 0.5 * (1 + math.cos(math.pi * update / UPDATES))


def points(update: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A few points a time, mostly in one corner, so that some texels rest for hundreds of updates."""
    rng = np.random.default_rng(update)
    uv = rng.random((6, 1, 2), np.float32) ** 3
    return torch.from_numpy(uv), torch.from_numpy(rng.integers(0, 3, (6, 1)).astype(np.uint8))


def learner(*, is_lazy: bool, beta1: float) -> tuple[NeuralTextures, Optimizer]:
    textures = NeuralTextures(object_layout((24, 16)), 4)
    groups = [ParameterGroup(parameters=[textures.table], lr=0.04)]
    optimizer = make_optimizer(groups, beta1=beta1, renderer=textures if is_lazy else None, pixels=1)
    assert (textures.lazy is not None) == is_lazy
    return textures, optimizer


def learn(textures: NeuralTextures, optimizer: Optimizer, updates: range) -> list[float]:
    losses = []
    for update in updates:
        uv, object_id = points(update)
        noise = torch.from_numpy(np.random.default_rng(-update % 7919).standard_normal((6, 1, 4), np.float32))
        target = torch.sin(7 * uv.sum(dim=-1, keepdim=True)) + 0.3 * noise
        loss = ((textures(uv, object_id) - target) * (object_id > 0)[..., None]).square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.param_groups[0]["lr"] = rate(update)
        optimizer.step()
        losses.append(loss.item())
    return losses


@pytest.mark.parametrize("beta1", [*(pytest.param(beta, marks=pytest.mark.full) for beta in (0.0, 0.5)), 0.9])
def test_texels_move_as_dense_adam_moves_them(beta1: float) -> None:
    (lazy, lazily), (dense, densely) = (learner(is_lazy=is_lazy, beta1=beta1) for is_lazy in (True, False))
    assert learn(lazy, lazily, range(UPDATES)) == pytest.approx(learn(dense, densely, range(UPDATES)), abs=2e-3)
    with torch.no_grad():  # Reading alone moves texels to where they are.
        np.testing.assert_allclose(lazy(*points(3)), dense(*points(3)), atol=2e-3)
    behind = (lazy.table - dense.table).abs().max()
    lazily.catch_up()
    error = (lazy.table - dense.table).detach().abs()
    assert dense.table.abs().max() > 1
    # Gradients near 1e-8 are the exception that the module names.
    assert error.max() < 1e-2 and error.mean() < 2e-5
    if beta1:
        assert behind > error.max()


def test_training_goes_on_to_the_bit_from_a_checkpoint_between_updates() -> None:
    whole, optimizer = learner(is_lazy=True, beta1=0.9)
    learn(whole, optimizer, range(60))
    with torch.inference_mode():  # An evaluation, which asks for no gradient, though the table does.
        whole(*points(1000))
    again, resumed = learner(is_lazy=True, beta1=0.9)
    again.load_state_dict({name: value.clone() for name, value in whole.state_dict().items()})
    resumed.load_state_dict(optimizer.state_dict())
    for textures, moves in ((whole, optimizer), (again, resumed)):
        learn(textures, moves, range(60, 90))
    assert torch.equal(whole.table, again.table)
    dense, densely = learner(is_lazy=False, beta1=0.9)
    learn(dense, densely, range(2))
    with pytest.raises(HyalineError, match="another version of hyaline; start over"):
        resumed.load_state_dict(densely.state_dict())


def test_a_gradient_that_is_not_finite_is_seen_before_a_step() -> None:
    textures, _ = learner(is_lazy=True, beta1=0.9)
    assert textures.lazy is not None
    (textures(*points(1)).sum() * math.nan).backward()
    assert not textures.lazy.is_finite()
