"""Owns what training makes small: a loss draws what it needs from the training pixels and compares."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from datagen.disk.errors import HyalineError
from model.batches.rays import PixelSource, draw_patches, take_colors
from model.losses.perceptual import VggSource, find_vgg
from model.settings.choices import LossChoices

LEAST_PATCH = 32
"""Rows and columns of the smallest patch that leaves a discriminator more than one value to normalise."""


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """What is made small besides the difference of each pixel, whose weight is 1 (mean absolute, sRGB of 0 to 1)."""

    softness: float = 0.0
    """Differences of pixels well below it count by their squares, those above by their size: the Charbonnier loss, less
    its value at 0. 0: all by their size, as in the paper. PSNR asks for squares."""
    vgg: VggSource | None = None
    """Whose features a perceptual term compares (section 4.4); None: there is none."""
    perceptual: float = 0.05
    """Weight of that term; the paper names none. Measured with random weights on a blurred prediction, its gradient by
    the colours of a patch is then a sixth as long as that of their mean absolute difference."""
    adversarial: float = 0.0
    """Weight of the adversarial term; 0: there is none. 0.01 is pix2pix's: L1 has a hundred times as much."""
    adversarial_from: float = 0.6
    """It begins when this share of the steps is done (after a warm-up without it: section 4.4)."""
    adversarial_lr: float = 0.0004
    """Learning rate of the discriminator, and from then on the most of every other (section 4.4)."""
    inpaint: bool = False
    """The discriminator judges poses without truth instead, where only texels that no training ray visited learn."""
    patch: int = 64
    """Height and width in pixels of the patches that these terms look at (U-Nets: of poses without truth alone)."""
    patches: int = 1
    """Of them, in each step, besides the random pixels."""

    def __post_init__(self) -> None:
        for name in ("softness", "perceptual", "adversarial"):
            if getattr(self, name) < 0:
                raise HyalineError(f"{name}: is {getattr(self, name)}; expected a weight of at least 0")
        if not 0 <= self.adversarial_from <= 1 or not 0 < self.adversarial_lr <= 1:
            raise HyalineError(f"adversarial_from: is {self.adversarial_from}; expected a share of the steps, 0 to 1")
        if self.patch < LEAST_PATCH or self.patches < 1:
            raise HyalineError(f"patch: is {self.patch}; expected at least {LEAST_PATCH} pixels")
        if self.inpaint and not self.adversarial:
            raise HyalineError("inpaint: needs the discriminator's judgement; give --adversarial, such as 0.01")

    @property
    def is_of_pixels(self) -> bool:
        """True when there are no other terms."""
        return self.vgg is None and not self.adversarial and not self.inpaint

    def describe(self) -> str:
        """What it brings in that no picture of the dataset has taught, in words; empty for nothing."""
        return self.vgg.describe() if self.vgg else ""


def configure_losses(choices: LossChoices) -> LossConfig:
    """The configuration that a user's choices make; weights of VGG are looked for.

    Raises:
        HyalineError: a choice that cannot be, or no such weights.
    """
    has_vgg = choices.vgg_weights != "none"
    if choices.perceptual is not None and not has_vgg:
        raise HyalineError("perceptual: there is no network to compare with; give --vgg-weights auto, random or a path")
    return LossConfig(
        vgg=find_vgg(choices.vgg, choices.vgg_weights) if has_vgg else None,
        perceptual=LossConfig.perceptual if choices.perceptual is None else choices.perceptual,
        adversarial=choices.adversarial,
        adversarial_from=choices.adversarial_from,
        inpaint=choices.inpaint,
        patch=choices.patch,
    )


@dataclass(frozen=True, kw_only=True)
class PatchTerms:
    """Terms of a step that look at patches: how many to draw, and the weighted sum of what (predicted, true) miss."""

    size: int
    number: int
    of: Callable[[Float32[Tensor, "patch row column 3"], Float32[Tensor, "patch row column 3"]], Tensor]


def pixel_loss(
    renderer: nn.Module,
    training: PixelSource,
    batch: int,
    rng: np.random.Generator,
    *,
    softness: float = 0.0,
    patch_terms: PatchTerms | None = None,
) -> Tensor:
    """Mean difference in sRGB of `batch` random pixels of all training images (section 4.4), and patch terms.

    Patches are rendered together with the pixels, so that batch norm sees both.

    Args:
        softness: differences well below it count by their squares (Charbonnier's penalty); 0: none.
    """
    index = torch.from_numpy(rng.integers(len(training.rgb), size=batch)).to(training.rgb.device)
    if patch_terms is None:
        colors = renderer(training.take(index, rng), rng=rng)
        return _soft_mean(difference(colors, take_colors(training, index)), softness)
    patches = draw_patches(training, patch_terms.number, patch_terms.size, rng)
    together = torch.cat([index, patches.flatten()])
    colors, truth = renderer(training.take(together, rng), rng=rng), take_colors(training, together)
    shape = (*patches.shape, 3)
    terms = patch_terms.of(colors[batch:].view(shape), truth[batch:].view(shape))
    return _soft_mean(difference(colors[:batch], truth[:batch]), softness) + terms


def difference(colors: Float32[Tensor, "*b 3"], truth: Float32[Tensor, "*b 3"]) -> Float32[Tensor, "*b 3"]:
    """Predicted minus true sRGB; 0 where the truth is white and the prediction beyond it.

    A picture clips: its 255 stands for anything brighter, and pulling a lamp of radiance 4 down to 1 would dim its
    reflections in glass, which are not clipped. Measured on the glass table (600 steps, at 20 and 40 degrees outside of
    the training cameras): +0.3 dB on both for `light-path`.
    """
    missed = colors - truth
    return torch.where(truth < 1, missed, missed.clamp_max(0))


def _soft_mean(differences: Float32[Tensor, "pixel 3"], softness: float) -> Tensor:
    """Their mean size; below `softness` they count by their squares."""
    if not softness:
        return differences.abs().mean()
    return (differences.square() + softness**2).sqrt().mean() - softness
