"""The losses of DeepVoxels beside L1: a game against a critic, and the generator that a step draws from."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor
from torch.nn import functional

from model.nets.voxel_nets import Critic

BORDER = 5
"""Pixels at each edge of a picture that the loss leaves out, since the rim is drawn from half-empty maps. The authors
cut them from what they score, too; here predictions are whole, as every other method's."""
L1_WEIGHT = 200.0
"""Of L1 against the critic's say."""


def adversarial_loss(critic: Critic, drawn: Float32[Tensor, "1 3 h w"], true: Float32[Tensor, "1 3 h w"]) -> Tensor:
    """Both sides of the game in one number, whose gradient moves each side its own way.

    The renderer's side is -log D(drawn), to which the critic's parameters are constant; the critic's side is
    -(log D(true) + log(1 - D(drawn))) / 2, to which the picture is constant. No parameter is on both sides, and Adam
    moves each parameter by itself: so one Adam over all of them takes the very steps that the authors' two optimisers
    of equal rate take, and a checkpoint of it resumes both.
    """
    fixed = {name: value.detach() for name, value in critic.named_parameters()}
    renderer_side = functional.softplus(-torch.func.functional_call(critic, fixed, (drawn,))).mean()
    on_true, on_drawn = functional.softplus(-critic(true)).mean(), functional.softplus(critic(drawn.detach())).mean()
    return renderer_side + 0.5 * (on_true + on_drawn)


@contextmanager
def seeded_torch(rng: np.random.Generator, device: torch.device) -> Iterator[None]:
    """Torch's own generator, which dropout draws from, seeded by a step's; as it was afterwards."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(int(rng.integers(2**62)))
        yield
