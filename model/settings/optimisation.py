"""Optimisation: steps, batches and learning rates. Each method has its own defaults."""

import math
from dataclasses import dataclass, field
from typing import Literal

from datagen.disk.errors import HyalineError
from model.settings.flags import AMOUNT, COUNT, check_limits, choice, unflagged
from model.settings.losses import LossConfig

LrDecay = Literal["none", "linear", "cosine"]
OptimizerKind = Literal["adam", "muon"]


@dataclass(frozen=True, kw_only=True)
class Optimisation:
    """The optimizer, its batches and its learning rates, for methods whose loss is their own."""

    batch: int = choice(8192, "batch{}", limits=COUNT)
    """Random pixels per step, drawn from all training images; for U-Nets about as many in crops, for deepvoxels images.
    The paper names no number; the authors' code takes one whole image per step. On a CPU a step's time is nearly
    proportional to it."""
    updates: int = choice(1, "{}-updates", limits=COUNT)
    """Weight updates per step, each from an equal part of its batch. For the same number of rays, more updates fit
    better."""
    optimizer: OptimizerKind = choice("adam", "{}")
    """adam (section 4.4), or muon: Muon for the network's matrices, Adam for the rest."""
    lr: float = choice(0.001, "lr{}")
    """Learning rate (section 4.4)."""
    texture_lr: float | None = choice(None, "texture-lr{}")
    """Learning rate of the textures. Default: the network's, as in the paper."""
    lr_decay: LrDecay = choice("linear", {"none": "no-decay", "": "{}-decay"})
    """Decay of the learning rate: none, linear (constant for the first half of the steps, then down to 0) or cosine.
    The paper's text names none; the authors' scripts use linear (100 epochs constant, 100 epochs linear)."""
    beta1: float = unflagged(0.9)
    """Adam's first decay rate; 0.5 in the authors' code."""
    weight_decay: float = unflagged(0.0, limits=AMOUNT)
    """Weight decay of the network alone, added to the gradient as Adam does; 0.0001 in the authors' code. Not with
    Muon."""
    steps: int = choice(2500, "{}-steps", limits=COUNT)
    """Optimizer steps; larger datasets need more. The paper names no number; at 128 x 128 pixels the held-out PSNR of
    `paper` flattens out by 2500."""

    def __post_init__(self) -> None:
        check_limits(self)
        if self.batch < 2 * self.updates:
            raise HyalineError(
                f"batch: is {self.batch}; expected at least 2 pixels for each of {self.updates} updates a step, "
                "batch norm needs a spread"
            )
        for name in ("lr", "texture_lr"):
            check_rate(name, getattr(self, name))
        if self.optimizer == "muon" and self.weight_decay:
            raise HyalineError("optimizer: is muon, which has no weight decay here; use adam")
        if not 0 <= self.beta1 < 1:
            raise HyalineError(f"beta1: is {self.beta1}; expected at least 0 and below 1")


@dataclass(frozen=True, kw_only=True)
class PixelOptimisation(Optimisation):
    """Optimisation, for methods that accept extra loss terms."""

    loss: LossConfig = field(default_factory=LossConfig)


def check_rate(name: str, rate: float | None) -> None:
    """Raises a HyalineError where Adam cannot learn at a rate; None stands for another one's."""
    if rate is not None and not 0 < rate <= 1:
        raise HyalineError(f"{name}: is {rate}; expected a learning rate in (0, 1], 0.001 in the paper")


def decay(kind: LrDecay, progress: float) -> float:
    """The factor on the learning rate after a share `progress`, in [0, 1), of the steps."""
    match kind:
        case "none":
            return 1.0
        case "linear":
            return min(1.0, 2 * (1 - progress))
        case "cosine":
            return 0.5 * (1 + math.cos(math.pi * progress))
