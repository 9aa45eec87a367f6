"""Tests of the optimizer: Adam is torch's to the bit, without its compiler; Muon moves as an SVD and torch say."""

import copy
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch import nn

from datagen.disk.errors import HyalineError
from model.methods.renderer import ParameterGroup
from model.run.optimizer import MOMENTUM, Muon, Optimizer, make_optimizer, matrices_of, orthogonalized
from model.settings import Optimisation

pytestmark = pytest.mark.usefixtures("one_thread")

STEP_WITHOUT_COMPILER = """
import sys
import torch
from model.methods.renderer import ParameterGroup
from model.run.optimizer import make_optimizer

weight = torch.ones(3, requires_grad=True)
optimizer = make_optimizer([ParameterGroup(parameters=[weight], lr=0.1)], beta1=0.9)
for _ in range(2):
    optimizer.zero_grad()
    (weight**2).sum().backward()
    optimizer.step()
optimizer.load_state_dict(optimizer.state_dict())
assert "torch._dynamo" not in sys.modules, "torch's compiler was loaded"
print(*weight.tolist())
"""


def test_steps_are_those_of_torch_s_own_adam_to_the_bit() -> None:
    def moved(make: type[torch.optim.Adam] | None) -> torch.Tensor:
        weight = torch.nn.Parameter(torch.linspace(-1, 1, 7))
        groups = [ParameterGroup(parameters=[weight], lr=0.03, weight_decay=0.01)]
        if make is None:
            optimizer = make_optimizer(groups, beta1=0.8)
        else:
            optimizer = make([weight], lr=0.03, weight_decay=0.01, betas=(0.8, 0.999), fused=True)
        for step in range(5):
            optimizer.zero_grad()
            (weight**3 * (step + 1)).sum().backward()
            optimizer.step()
        return weight.detach()

    assert torch.equal(moved(None), moved(torch.optim.Adam))
    assert not torch.equal(moved(None), torch.linspace(-1, 1, 7))


def test_a_training_loads_no_compiler() -> None:
    done = subprocess.run(
        [sys.executable, "-c", STEP_WITHOUT_COMPILER], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert all(0.75 < float(word) < 0.85 for word in done.stdout.split())


@pytest.mark.parametrize("shape", [(32, 32), (128, 9), (32, 60)])
def test_singular_values_become_about_1_and_singular_vectors_stay(shape: tuple[int, int]) -> None:
    matrix = torch.from_numpy(np.random.default_rng(0).standard_normal(shape, np.float32))
    left, _, right = torch.linalg.svd(matrix, full_matrices=False)
    found = left.T @ orthogonalized(matrix) @ right.T
    values = found.diagonal()
    assert ((values > 0.6) & (values < 1.25)).all()
    assert (found - torch.diag(values)).abs().max() < 1e-4


def test_steps_are_those_of_torch_s_muon_but_for_its_rounding() -> None:
    if not hasattr(torch.optim, "Muon"):
        pytest.skip("this torch has no Muon")
    rng = np.random.default_rng(1)
    start = rng.standard_normal((24, 10), np.float32)
    ours, theirs = (nn.Parameter(torch.from_numpy(start.copy())) for _ in range(2))
    muon = Muon([ours])
    other = torch.optim.Muon([theirs], lr=0.01, weight_decay=0, momentum=MOMENTUM, adjust_lr_fn="match_rms_adamw")
    for _ in range(6):
        gradient = torch.from_numpy(rng.standard_normal((24, 10), np.float32))
        ours.grad, theirs.grad = gradient.clone(), gradient.clone()
        muon.step(0.01)
        other.step()
    moved, by_torch = (value.detach() - torch.from_numpy(start) for value in (ours, theirs))
    assert moved.square().mean().sqrt() > 0.005
    assert (moved - by_torch).norm() < 0.02 * by_torch.norm()


def learner() -> tuple[nn.Sequential, Optimizer]:
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(6, 8), nn.Tanh(), nn.Linear(8, 3))
    return net, make_optimizer([ParameterGroup(parameters=list(net.parameters()), lr=0.02)], beta1=0.9, kind="muon")


def learn(net: nn.Sequential, optimizer: Optimizer, steps: range) -> float:
    loss = torch.zeros(())
    for step in steps:
        x = torch.from_numpy(np.random.default_rng(step).standard_normal((64, 6), np.float32))
        loss = (net(x) - x[:, :3] * x[:, 3:]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return loss.item()


def test_muon_moves_hidden_matrices_and_adam_all_else() -> None:
    net, optimizer = learner()
    assert [tuple(value.shape) for value in matrices_of(list(net.parameters()))] == [(8, 6)]
    assert [value.numel() for value in optimizer.param_groups[0]["params"]] == [8, 24, 3]
    before = [value.detach().clone() for value in net.parameters()]
    first, last = learn(net, optimizer, range(1)), learn(net, optimizer, range(1, 300))
    assert all(not torch.equal(old, new) for old, new in zip(before, net.parameters(), strict=True))
    assert last < 0.5 * first


def test_training_goes_on_to_the_bit_from_a_checkpoint() -> None:
    net, optimizer = learner()
    learn(net, optimizer, range(20))
    again, resumed = learner()
    again.load_state_dict({name: value.clone() for name, value in net.state_dict().items()})
    resumed.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    assert learn(net, optimizer, range(20, 40)) == learn(again, resumed, range(20, 40))


def test_what_muon_cannot_move_is_an_error() -> None:
    with pytest.raises(HyalineError, match="network has no matrices; use adam"):
        make_optimizer([ParameterGroup(parameters=[nn.Parameter(torch.zeros(9))], lr=0.1)], beta1=0.9, kind="muon")
    with pytest.raises(HyalineError, match="has no weight decay here"):
        Optimisation(optimizer="muon", weight_decay=1e-4)
