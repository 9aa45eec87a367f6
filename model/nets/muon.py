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
        moves = orthogonalized(ahead)
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


def orthogonalized(matrices: Sequence[Float32[Tensor, "_ _"]]) -> list[Float32[Tensor, "_ _"]]:
    """Matrices with the same singular vectors and singular values between about 0.7 and 1.2; those below a thousandth
    of a matrix's largest stay smaller.

    On a GPU, where each operation is a launch, all are padded to one size.
    """
    wide = [matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T for matrix in matrices]
    if wide[0].is_cuda:
        together = wide[0].new_zeros(
            len(wide), *(max(sides) for sides in zip(*(each.shape for each in wide), strict=True))
        )
        for place, matrix in zip(together, wide, strict=True):
            place[: matrix.shape[0], : matrix.shape[1]] = matrix
        found = [place[: each.shape[0], : each.shape[1]] for place, each in zip(_iterated(together), wide, strict=True)]
    else:
        found = [_iterated(matrix[None])[0] for matrix in wide]
    return [each if each.shape == matrix.shape else each.T for each, matrix in zip(found, matrices, strict=True)]


def _iterated(matrices: Float32[Tensor, "matrix row column"]) -> Float32[Tensor, "matrix row column"]:
    """Newton and Schulz's iteration with Jordan's coefficients, for matrices of at most as many rows as columns."""
    a, b, c = COEFFICIENTS
    found = matrices / (torch.linalg.vector_norm(matrices, dim=(1, 2), keepdim=True) + 1e-7)
    for _ in range(ITERATIONS):
        gram = torch.bmm(found, found.mT)
        found = torch.baddbmm(found, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), found, beta=a)
    return found
