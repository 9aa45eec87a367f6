"""The optimizer of a run: Adam, with Muon for a network's matrices and lazy Adams for large textures."""

# pyright: reportPrivateImportUsage=false

import inspect
import math
from collections.abc import Sequence
from typing import Any, cast

import torch
from jaxtyping import Float32
from torch import Tensor, nn

from datagen.disk.errors import HyalineError
from model.methods.renderer import ParameterGroup
from model.nets.texels import LazyAdam
from model.nets.texture import NeuralTextures
from model.settings import OptimizerKind
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
    """The optimizer of some matrices: each moves by its momentum with all singular values near 1.

    Adam moves each number by itself, so a few directions of a matrix learn and others hardly do. Source: Jordan et al.
    2024 (kellerjordan.github.io/posts/muon), with the step's size of Liu et al. 2025 (arXiv 2502.16982), whose root
    mean square is that of Adam's: one learning rate fits both. `torch.optim.Muon` computes in bfloat16, which many
    processors lack, and is not in every torch that hyaline allows.
    """

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
        for momentum, found in zip(self._momentum, cast(list[Tensor], state), strict=True):
            momentum.copy_(found)


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


class Optimizer(torch.optim.Adam):
    """torch's Adam, to the bit, without `import torch._dynamo`, which takes 3 s of CPU time.

    torch wraps its optimizers' methods, and each wrapper imports the compiler. `step` here is the method inside the
    wrapper; the others get the attribute that torch 2.13 caches the compiler in.

    Large textures have a `LazyAdam` each, which moves the texels that an update reads. `Muon` may move the matrices of
    the first group, the network's, at that group's rate; they are in no group then.
    """

    lazy: Sequence[LazyAdam] = ()
    """Optimizers of the large tables in the group of textures."""
    lazy_group = 0
    """Index of that parameter group."""
    muon: Muon | None = None

    @torch.no_grad()
    def step(self, closure: None = None) -> None:
        """Moves every parameter by its gradient."""
        inspect.unwrap(torch.optim.Adam.step)(self, closure)
        for owner in self.lazy:
            owner.step(self.param_groups[self.lazy_group]["lr"])
        if self.muon is not None:
            self.muon.step(self.param_groups[0]["lr"])

    def zero_grad(self, set_to_none: bool = True) -> None:
        super().zero_grad(set_to_none)
        if self.muon is not None:
            self.muon.zero_grad()

    def state_dict(self) -> dict[str, Any]:
        muon = {} if self.muon is None else {"muon": self.muon.state()}
        return {**super().state_dict(), "lazy": [owner.state() for owner in self.lazy], **muon}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        others = dict(state_dict)
        states, momentum = others.pop("lazy", []), others.pop("muon", None)
        if len(states) != len(self.lazy) or (momentum is None) != (self.muon is None):
            raise HyalineError(
                "the checkpoint's optimiser is of another version of hyaline; start over with --overwrite"
            )
        super().load_state_dict(others)
        for owner, state in zip(self.lazy, states, strict=True):
            owner.load_state(state)
        if self.muon is not None:
            self.muon.load_state(momentum)

    def catch_up(self) -> None:
        """Moves the texels that no recent update has read to where they are now."""
        for owner in self.lazy:
            owner.catch_up()


for _name in ("add_param_group", "zero_grad", "state_dict", "load_state_dict"):
    _method = inspect.unwrap(getattr(torch.optim.Optimizer, _name))
    _method.__dict__.setdefault("__dynamo_disable", _method)


TEXELS_A_PIXEL = 64
"""Texels for each pixel of an update from which on a texture is moved lazily. A pixel of `light-path` reads some 100,
many of them again; one of `paper` 20 to 50, of `paper-best` with its four rays 80 to 200. The second level of the
demo's `paper-best` has 72 for each pixel: moved lazily, it makes a step 0.87 times as long (two pairs in turns)."""


def make_optimizer(
    groups: list[ParameterGroup],
    *,
    beta1: float,
    kind: OptimizerKind = "adam",
    renderer: nn.Module | None = None,
    pixels: int = 0,
) -> Optimizer:
    """Dense Adam, as in the paper: texels keep moving by their momentum after the step that touched them.

    Args:
        groups: the network's first.
        kind: muon: Muon moves the network's matrices.
        renderer: its large textures are moved lazily, on a CPU; None: no texture is.
        pixels: of an update.

    Raises:
        HyalineError: the network has no matrices that Muon could move.
    """
    matrices = matrices_of(groups[0].parameters) if kind == "muon" else []
    if kind == "muon" and not matrices:
        raise HyalineError("optimizer: is muon, but this method's network has no matrices; use adam")
    apart = {id(value) for value in matrices}
    optimizer = Optimizer(
        [
            {
                "params": [value for value in group.parameters if id(value) not in apart],
                "lr": group.lr,
                "weight_decay": group.weight_decay,
                "eps": group.eps,
            }
            for group in groups
        ],
        betas=(beta1, 0.999),
        fused=True,
    )
    if matrices:
        optimizer.muon = Muon(matrices)
    for part in () if renderer is None else renderer.modules():
        if not isinstance(part, NeuralTextures) or part.table.device.type != "cpu":
            continue
        if part.layout.num_texels <= TEXELS_A_PIXEL * pixels:
            continue
        part.lazy = LazyAdam(part.table, beta1=beta1)
        optimizer.lazy = [*optimizer.lazy, part.lazy]
        (optimizer.lazy_group,) = (
            index for index, group in enumerate(groups) if any(value is part.table for value in group.parameters)
        )
    return optimizer
