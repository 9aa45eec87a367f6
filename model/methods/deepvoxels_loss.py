"""Owns what a training step of DeepVoxels makes small: L1 on two views that it draws, and a game against a critic."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

from datagen.disk.errors import HyalineError
from model.batches.rays import PixelSource
from model.batches.view_batches import Views
from model.methods.deepvoxels import DeepVoxels
from model.nets.voxel_nets import Critic

BORDER = 5
"""Pixels at each edge of a picture that the loss leaves out, since the rim is drawn from half-empty maps. The authors
cut them from what they score, too; here predictions are whole, as every other method's."""
L1_WEIGHT = 200.0
"""Of L1 against the critic's say."""


def deepvoxels_loss(renderer: nn.Module, training: PixelSource, batch: int, rng: np.random.Generator) -> Tensor:
    """Lifts one view into the grid, draws `batch` others from it, and compares.

    The view lifted is one of the four whose axes are nearest to the first target's. The authors go through all first
    targets in epochs; here each step draws its own, so that a stopped run goes on with the same ones.

    Raises:
        HyalineError: there are not two training views.
    """
    assert isinstance(renderer, DeepVoxels)
    assert isinstance(training, Views)
    if training.num_views < 2:
        raise HyalineError(f"train: has {training.num_views} view to learn from; deepvoxels needs at least 2")
    targets = rng.choice(training.num_views, size=min(batch, training.num_views), replace=False).tolist()
    source = int(rng.choice(training.neighbours(targets[0])))
    with seeded_torch(rng, training.rgb.device):
        inpainted = renderer.inpaint(renderer.observe(training.image(source), training.camera(source)))
        inside = slice(BORDER, -BORDER)
        losses = []
        for target in targets:
            drawn = renderer.draw(inpainted, training.camera(target))[..., inside, inside]
            true = training.image(target)[..., inside, inside]
            loss = (drawn - true).abs().mean()
            if renderer.critic is not None:
                loss = L1_WEIGHT * loss + adversarial_loss(renderer.critic, drawn - 0.5, true - 0.5)
            losses.append(loss)
        return torch.stack(losses).mean()


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
