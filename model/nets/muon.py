"""Muon, an optimizer for the matrices of a network: each moves by its momentum with all singular values near 1.

Adam moves each number by itself, so a few directions of a matrix learn and others hardly do. Source: Jordan et al. 2024
(kellerjordan.github.io/posts/muon), with the step's size of Liu et al. 2025 (arXiv 2502.16982), whose root mean square
is that of Adam's: one learning rate fits both. `torch.optim.Muon` computes in bfloat16, which many processors lack, and
is not in every torch that hyaline allows.
"""

# pyright: reportPrivateImportUsage=false

import math
from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Float32
from torch import Tensor, nn

from model.nets.lazy_adam import check_states
from model.state import State

MOMENTUM = 0.95
COEFFICIENTS = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5
RMS = 0.2
"""Root mean square of Adam's steps, as a share of the learning rate."""

LEAST_OUTPUTS = 5
"""Matrices with fewer outputs are a network's last, which make its colours: these belong to Adam."""


def matrices_of(parameters: Sequence[nn.Parameter]) -> list[nn.Parameter]:
    """Those of a network's parameters that Muon moves."""
    return [value for value in parameters if value.ndim == 2 and len(value) >= LEAST_OUTPUTS]


class Muon:
    """The optimizer's state of some matrices."""

    def __init__(self, matrices: Sequence[nn.Parameter]) -> None:
        self._matrices: list[Tensor] = list(matrices)
        self._momentum = [torch.zeros_like(value, requires_grad=False) for value in matrices]

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Moves all matrices by their gradients."""
        gradients = [cast(Tensor, matrix.grad) for matrix in self._matrices]
        torch._foreach_lerp_(self._momentum, gradients, 1 - MOMENTUM)
        ahead = torch._foreach_lerp(gradients, self._momentum, MOMENTUM)  # Nesterov's
        moves = [orthogonalized(matrix) for matrix in ahead]
        torch._foreach_mul_(moves, [-rate * RMS * math.sqrt(max(move.shape)) for move in moves])
        torch._foreach_add_(self._matrices, moves)

    def zero_grad(self) -> None:
        for matrix in self._matrices:
            matrix.grad = None

    def state(self) -> State:
        """State for a checkpoint."""
        return cast(State, list(self._momentum))

    def load_state(self, state: State) -> None:
        for momentum, found in zip(self._momentum, check_states(state, len(self._momentum)), strict=True):
            momentum.copy_(cast(Tensor, found))


def orthogonalized(matrix: Float32[Tensor, "row column"]) -> Float32[Tensor, "row column"]:
    """A matrix with the same singular vectors and singular values between about 0.7 and 1.2; those below a thousandth
    of its largest stay smaller. By Newton and Schulz's iteration with Jordan's coefficients."""
    if matrix.shape[0] > matrix.shape[1]:
        return orthogonalized(matrix.T).T
    a, b, c = COEFFICIENTS
    found = matrix[None] / (torch.linalg.vector_norm(matrix[None], dim=(1, 2), keepdim=True) + 1e-7)
    for _ in range(ITERATIONS):
        gram = torch.bmm(found, found.mT)
        found = torch.baddbmm(found, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), found, beta=a)
    return found[0]
