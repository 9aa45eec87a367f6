"""What training makes small: a loss draws what it needs from the training pixels and compares."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from datagen.disk.errors import HyalineError
from model.batches.rays import PixelSource, draw_patches, take_colors
from model.batches.samples import mean_color, variance_of_mean
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
    debias: float = 0.0
    """Share of what the noise of the training rays adds to the loss that is taken off again (`noise_penalty`)."""
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
        if not 0 <= self.debias <= 1:
            raise HyalineError(f"debias: is {self.debias}; expected a share of 0 to 1")
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
    debias: float = 0.0,
    patch_terms: PatchTerms | None = None,
) -> Tensor:
    """Mean difference in sRGB of `batch` random pixels of all training images (section 4.4), and patch terms.

    Patches are rendered together with the pixels, so that batch norm sees both.

    Args:
        softness: differences well below it count by their squares (Charbonnier's penalty); 0: none.
        debias: share of `noise_penalty` that is taken off the loss, for renderers that draw several rays a pixel.
    """
    index = torch.from_numpy(rng.integers(len(training.rgb), size=batch)).to(training.rgb.device)
    if patch_terms is None:
        colors, variance = _render(renderer, training.take(index, rng), rng, debias)
        return _soft_mean(difference(colors, take_colors(training, index)), softness, variance)
    patches = draw_patches(training, patch_terms.number, patch_terms.size, rng)
    together = torch.cat([index, patches.flatten()])
    colors, variance = _render(renderer, training.take(together, rng), rng, debias)
    truth = take_colors(training, together)
    shape = (*patches.shape, 3)
    terms = patch_terms.of(colors[batch:].view(shape), truth[batch:].view(shape))
    variance = None if variance is None else variance[:batch]
    return _soft_mean(difference(colors[:batch], truth[:batch]), softness, variance) + terms


@runtime_checkable
class SampledRenderer(Protocol):
    """A renderer that draws several rays a pixel and tells the radiance of each."""

    def radiance(self, batch: Any, /) -> Float32[Tensor, "pixel sample 3"]: ...


def _render(
    renderer: nn.Module, batch: object, rng: np.random.Generator, debias: float
) -> tuple[Float32[Tensor, "pixel 3"], Float32[Tensor, "pixel 3"] | None]:
    """sRGB colours, and the share `debias` of the variance that the choice of rays gives them, where that is known."""
    if not debias or not isinstance(renderer, SampledRenderer):
        return renderer(batch, rng=rng), None
    radiance = renderer.radiance(batch)
    return mean_color(radiance), debias * variance_of_mean(radiance)


def difference(colors: Float32[Tensor, "*b 3"], truth: Float32[Tensor, "*b 3"]) -> Float32[Tensor, "*b 3"]:
    """Predicted minus true sRGB; 0 where the truth is white and the prediction beyond it.

    A picture clips: its 255 stands for anything brighter, and pulling a lamp of radiance 4 down to 1 would dim its
    reflections in glass, which are not clipped. Measured on the glass table (600 steps, at 20 and 40 degrees outside of
    the training cameras): +0.3 dB on both for `light-path`.
    """
    missed = colors - truth
    return torch.where(truth < 1, missed, missed.clamp_max(0))


def noise_penalty(
    differences: Float32[Tensor, "pixel 3"], variance: Float32[Tensor, "pixel 3"], softness: float
) -> Float32[Tensor, "pixel 3"]:
    """What noise of a variance adds to Charbonnier's penalty of the differences, to second order.

    Few rays hit a lamp's reflection in a rough surface, and their mean is noisy. Squares punish noise as they punish
    error: a renderer learns to dim lamps and to blur textures, because what varies less from ray to ray costs less.
    Twelve lobes learned 1.7 towards a lamp of 3.8, and the longer they learned, the dimmer. The penalty's mean over
    noise of variance v is that of the noiseless difference plus v / 2 times its second derivative. Gradients flow
    through the variance alone. A truth that is white, and exceeded, asks for nothing. The same idea, with two
    independent renderings: Deng et al. 2022, "Reconstructing Translucent Objects using Differentiable Rendering".

    Long runs still come to ripple on rough surfaces (RESULTS.md), so no method does it by default.

    The variance has to be one that independent groups of rays tell. Half of the spread of rays in cells of their own is
    right on average, but then ripples that cancel within a pixel are paid for: after 1,500 steps those of a rough floor
    cost 3 dB. The second derivative is taken as far out as the noise reaches: at a difference of 0 that is the mean of
    two large ones it would pay for noise without limit.
    """
    given = differences.detach()
    curvature = softness**2 / (given.square() + variance.detach() + softness**2) ** 1.5
    return torch.where(given == 0, 0.0, 0.5 * curvature * variance)


def _soft_mean(
    differences: Float32[Tensor, "pixel 3"], softness: float, variance: Float32[Tensor, "pixel 3"] | None
) -> Tensor:
    """Their mean size; below `softness` they count by their squares, less what noise of a variance adds."""
    if not softness:  # Sizes have no curvature: noise that is small beside them adds nothing.
        return differences.abs().mean()
    penalty = (differences.square() + softness**2).sqrt().mean() - softness
    return penalty if variance is None else penalty - noise_penalty(differences, variance, softness).mean()
