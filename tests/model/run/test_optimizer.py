"""Tests of the optimizer: torch's own Adam to the bit, and no compiler loaded for it."""

import subprocess
import sys

import torch

from model.methods.renderer import ParameterGroup
from model.run.optimizer import make_optimizer

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
