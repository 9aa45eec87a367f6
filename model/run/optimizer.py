"""The optimizer of a run: Adam, with Muon for a network's matrices and lazy Adams for large textures."""

import inspect
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from datagen.disk.errors import HyalineError
from model.methods.renderer import ParameterGroup
from model.nets.lazy_adam import LazyAdam, check_states
from model.nets.muon import Muon, matrices_of
from model.nets.texture import NeuralTextures
from model.settings import OptimizerKind


class Optimizer(torch.optim.Adam):
    """torch's Adam, to the bit, without `import torch._dynamo`, which takes 3 s of CPU time.

    torch wraps its optimizers' methods so that `torch.compile` leaves them alone, and each wrapper imports the compiler
    for that. `step` here is the method inside the wrapper; the others get the attribute that torch 2.13 caches it in.
    A torch that caches it elsewhere imports its compiler as before.

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
        states = check_states(others.pop("lazy", []), len(self.lazy))
        momentum = others.pop("muon", None)
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
