"""The losses of a run: the method's own, and the terms added to it, some of which learn themselves."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn

from model.batches.rays import PixelSource, draw_patches, take_colors
from model.losses.adversarial import Adversary
from model.losses.inpaint import Inpainter
from model.losses.perceptual import PerceptualLoss
from model.losses.pixel_losses import PatchTerms
from model.settings.losses import LossConfig
from model.settings.state import State


@runtime_checkable
class OwnLoss(Protocol):
    """What a renderer's own loss takes (model/methods/renderer.py)."""

    def __call__(
        self,
        training: PixelSource,
        batch: int,
        rng: np.random.Generator,
        *,
        softness: float = 0.0,
        patch_terms: PatchTerms | None = None,
    ) -> Tensor: ...


class Losses:
    """A method's own loss with the further terms of a configuration, and what these learn."""

    def __init__(
        self,
        config: LossConfig,
        *,
        steps: int,
        seed: int,
        device: torch.device,
        make_inpainter: Callable[[], Inpainter],
    ) -> None:
        """Raises a HyalineError where weights of VGG are not there, or there is nothing to in-paint."""
        self.config = config
        self.first_adversarial_step = round(config.adversarial_from * steps)
        self.perceptual = PerceptualLoss(config.vgg, config.vgg_weights).to(device) if config.has_vgg else None
        self.adversary = (
            Adversary(lr=config.adversarial_lr, seed=seed, device=device) if config.adversarial > 0 else None
        )
        self.inpainter = make_inpainter() if config.inpaint else None

    def is_adversarial(self, step: int) -> bool:
        return self.adversary is not None and step >= self.first_adversarial_step

    def limit_rate(self, rate: float, step: int) -> float:
        """The learning rate of a step: no higher than the adversarial one as soon as that term is there."""
        return min(rate, self.config.adversarial_lr) if self.is_adversarial(step) else rate

    def loss(
        self,
        own: OwnLoss,
        renderer: nn.Module,
        training: PixelSource,
        batch: int,
        rng: np.random.Generator,
        *,
        step: int,
    ) -> Tensor:
        """What step `step` makes small, `own` being the renderer's loss. The discriminator has learned afterwards."""
        config, is_adversarial = self.config, self.is_adversarial(step)
        size = min(config.patch, training.resolution.shorter)

        def of_patches(colors: Tensor, truth: Tensor) -> Tensor:
            total = colors.new_zeros(())
            if self.perceptual is not None:
                total = total + config.perceptual * self.perceptual(colors, truth)
            if is_adversarial and self.inpainter is None:
                assert self.adversary is not None
                total = total + config.adversarial * self.adversary.loss(colors, truth)
            return total

        has_terms = self.perceptual is not None or (is_adversarial and self.inpainter is None)
        terms = PatchTerms(size=size, number=config.patches, of=of_patches) if has_terms else None
        total = own(training, batch, rng, softness=config.softness, patch_terms=terms)
        if is_adversarial and self.inpainter is not None:
            assert self.adversary is not None
            index = draw_patches(training, config.patches, size, rng)
            real = take_colors(training, index.flatten()).view(*index.shape, 3)
            fake = self.inpainter.render(renderer, config.patches, size, rng)
            total = total + config.adversarial * self.adversary.loss(fake, real)
        return total

    def state(self) -> State:
        return None if self.adversary is None else self.adversary.state()

    def load_state(self, state: State) -> None:
        if self.adversary is not None:
            self.adversary.load_state(state)
