"""What training makes small: a loss draws what it needs from the training pixels and compares."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from model.batches.rays import PixelSource, draw_patches, mean_color, take_colors, variance_of_mean

Radiance = Callable[..., tuple[Float32[Tensor, "pixel sample 3"], Float32[Tensor, "pixel sample 3"] | None]]
"""Linear radiance of every ray of a batch, and the same numbers again with gradients of the sky alone. Where there is
no second, the first has all gradients."""

SQUARES = 10.0
"""What the squares count from which a sky learns: near 0 as much as Charbonnier's penalty of softness 0.05."""


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
    radiance: Radiance | None = None,
    debias: float = 0.0,
    patch_terms: PatchTerms | None = None,
) -> Tensor:
    """Mean difference in sRGB of `batch` random pixels of all training images (section 4.4), and patch terms.

    Patches are rendered together with the pixels, so that batch norm sees both.

    Args:
        softness: differences well below it count by their squares (Charbonnier's penalty); 0: none.
        radiance: linear radiance of every ray of a batch, of renderers that draw several rays a pixel. A sky apart
            learns from the random pixels alone, not from patch terms.
        debias: share of `noise_penalty` that is taken off the loss then.
    """
    index = torch.from_numpy(rng.integers(len(training.rgb), size=batch)).to(training.rgb.device)
    patches = None if patch_terms is None else draw_patches(training, patch_terms.number, patch_terms.size, rng)
    together = index if patches is None else torch.cat([index, patches.flatten()])
    rendered = _render(renderer, training.take(together, rng), rng, radiance, debias)
    truth = take_colors(training, together)
    loss = _pixel_terms(rendered, truth, softness, batch)
    if patch_terms is None or patches is None:
        return loss
    shape = (*patches.shape, 3)
    return loss + patch_terms.of(rendered.colors[batch:].view(shape), truth[batch:].view(shape))


@dataclass(frozen=True, kw_only=True)
class _Rendered:
    """Pixels as a renderer draws them."""

    colors: Float32[Tensor, "pixel 3"]
    """sRGB."""
    variance: Float32[Tensor, "pixel 3"] | None = None
    """What the choice of rays gives the colours, as far as it is taken off the loss; None: it is not known."""
    of_sky: "_Rendered | None" = None
    """The same with gradients of the sky alone, of renderers whose sky learns apart."""


def _render(
    renderer: nn.Module, batch: object, rng: np.random.Generator, radiance: Radiance | None, debias: float
) -> _Rendered:
    """The pixels of a batch; `debias`: share of the variance that is taken off."""
    if not debias or radiance is None:
        return _Rendered(colors=renderer(batch, rng=rng))
    rays, rays_of_sky = radiance(batch)
    of_sky = None if rays_of_sky is None else _average(rays_of_sky, debias)
    return dataclasses.replace(_average(rays, debias), of_sky=of_sky)


def _average(rays: Float32[Tensor, "pixel sample 3"], debias: float) -> _Rendered:
    return _Rendered(colors=mean_color(rays), variance=debias * variance_of_mean(rays))


def _pixel_terms(rendered: _Rendered, truth: Float32[Tensor, "_ 3"], softness: float, number: int) -> Tensor:
    """The loss of the first `number` pixels. What a sky learns from adds gradients, and nothing to its value."""
    missed, variance = _misses(rendered, truth, number)
    loss = _soft_mean(missed, softness, variance)
    if rendered.of_sky is None:
        return loss
    squares = _mean_square(*_misses(rendered.of_sky, truth, number))
    return loss + (squares - squares.detach())


def _misses(
    rendered: _Rendered, truth: Float32[Tensor, "_ 3"], number: int
) -> tuple[Float32[Tensor, "pixel 3"], Float32[Tensor, "pixel 3"] | None]:
    """Differences of the first `number` pixels from the truth, and their variance."""
    variance = None if rendered.variance is None else rendered.variance[:number]
    return difference(rendered.colors[:number], truth[:number]), variance


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

    The variance has to be one that independent groups of rays tell. Half of the spread of rays in cells of their own is
    right on average, but then ripples that cancel within a pixel are paid for, and grow on rough surfaces (docs/notes).
    The second derivative is taken as far out as the noise reaches: at a difference of 0 that is the mean of two large
    ones it would pay for noise without limit.
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


def _mean_square(differences: Float32[Tensor, "pixel 3"], variance: Float32[Tensor, "pixel 3"] | None) -> Tensor:
    """Their squares, less what noise of a variance adds: what a sky learns from.

    Where a rough surface mirrors a lamp, a few rays hit it and most miss, so a pixel's colour is mostly below its mean
    and now and then far above. Charbonnier's penalty, which is a size there, is smallest where the *median* is right,
    and gradients reach the lamp from the hits alone: it stays too dim, however exactly noise is subtracted. Squares are
    smallest at the mean, and what noise adds to them is its variance, to any order. For textures the penalty stays: by
    squares they follow noisy training pictures. Measured on `vitrine` and `plant_shelf` of `standard` (400 steps): the
    lamp of 3.5 is learned as 2.4 (1.2 by the penalty), the worst extrapolating view of `vitrine` gains 4.0 dB.
    """
    assert variance is not None
    return SQUARES * torch.where(differences.detach() == 0, 0.0, differences.square() - variance).mean()
