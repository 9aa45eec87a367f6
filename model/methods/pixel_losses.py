"""Losses on random training pixels: L1 or Charbonnier differences, noise correction, patch terms."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from model.batches.rays import (
    PixelSource,
    draw_patches,
    draw_rows,
    mean_color,
    take_colors,
    to_device,
    variance_of_mean,
)

Radiance = Callable[..., tuple[Float32[Tensor, "pixel sample 3"], Float32[Tensor, "pixel sample 3"] | None]]
"""Linear radiance of every ray of a batch, and the same numbers again with only the sky's gradients. Without the
second, the first has all gradients."""

SQUARES = 10.0
"""Weight of the sky's squared errors: near 0 it equals Charbonnier's penalty of softness 0.05."""


@dataclass(frozen=True, kw_only=True)
class PatchTerms:
    """Loss terms on patches: how many to draw, and the weighted sum of the terms for (predicted, true)."""

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
        softness: differences well below it are squared (Charbonnier's penalty); 0: L1.
        radiance: linear radiance of every ray of a batch, for renderers with several rays per pixel. A separately
            trained sky learns only from the random pixels, not from patch terms.
        debias: share of `noise_penalty` that is then subtracted from the loss.
    """
    index = to_device({"index": draw_rows(training, batch, rng)}, training.rgb.device)["index"]
    patches = None if patch_terms is None else draw_patches(training, patch_terms.number, patch_terms.size, rng)
    together = index if patches is None else torch.cat([index, patches.flatten()])
    rendered = _render(renderer, training.take(together, rng), rng, radiance, debias)
    truth = take_colors(training, together)
    missed, variance = _misses(rendered, truth, batch)
    loss = _soft_mean(missed, softness, variance)
    if rendered.of_sky is not None:  # Adds gradients, but nothing to the value.
        squares = _mean_square(*_misses(rendered.of_sky, truth, batch))
        loss = loss + (squares - squares.detach())
    if patch_terms is None or patches is None:
        return loss
    shape = (*patches.shape, 3)
    return loss + patch_terms.of(rendered.colors[batch:].view(shape), truth[batch:].view(shape))


@dataclass(frozen=True, kw_only=True)
class _Rendered:
    """Rendered pixels."""

    colors: Float32[Tensor, "pixel 3"]
    """sRGB."""
    variance: Float32[Tensor, "pixel 3"] | None = None
    """Variance of the colours over the choice of rays, times the share that is subtracted; None: unknown."""
    of_sky: "_Rendered | None" = None
    """The same with only the sky's gradients, for renderers with a separately trained sky."""


def _render(
    renderer: nn.Module, batch: object, rng: np.random.Generator, radiance: Radiance | None, debias: float
) -> _Rendered:
    """The pixels of a batch; `debias`: share of the variance that is taken off."""
    if not debias or radiance is None:
        return _Rendered(colors=renderer(batch, rng=rng))
    rays, rays_of_sky = radiance(batch)
    parts = [rays] if rays_of_sky is None else [rays, rays_of_sky]
    together = torch.cat(parts)  # On a GPU, each operation is a launch.
    values = mean_color(together), debias * variance_of_mean(together)
    colors, variances = (value.unflatten(0, (len(parts), -1)).unbind() for value in values)
    found = [_Rendered(colors=color, variance=variance) for color, variance in zip(colors, variances, strict=True)]
    return dataclasses.replace(found[0], of_sky=found[1] if found[1:] else None)


def _misses(
    rendered: _Rendered, truth: Float32[Tensor, "_ 3"], number: int
) -> tuple[Float32[Tensor, "pixel 3"], Float32[Tensor, "pixel 3"] | None]:
    """Differences of the first `number` pixels from the truth, and their variance."""
    variance = None if rendered.variance is None else rendered.variance[:number]
    return difference(rendered.colors[:number], truth[:number]), variance


def difference(colors: Float32[Tensor, "*b 3"], truth: Float32[Tensor, "*b 3"]) -> Float32[Tensor, "*b 3"]:
    """Predicted minus true sRGB; 0 where the truth is white and the prediction is brighter.

    Pictures clip: 255 may mean anything brighter, and pulling a lamp of radiance 4 down to 1 would dim its reflections
    in glass, which are not clipped. Measured on the glass table (600 steps, at 20 and 40 degrees outside of the
    training cameras): +0.3 dB on both for `light-path`.
    """
    missed = colors - truth
    return torch.where(truth < 1, missed, missed.clamp_max(0))


def noise_penalty(
    differences: Float32[Tensor, "pixel 3"], variance: Float32[Tensor, "pixel 3"], softness: float
) -> Float32[Tensor, "pixel 3"]:
    """The bias that noise of a variance adds to Charbonnier's penalty of the differences, to second order.

    Few rays hit a lamp's reflection in a rough surface, so their mean is noisy. Squares penalise noise like error: a
    renderer learns to dim lamps and to blur textures, because less variation between rays costs less. Twelve lobes
    learned a radiance of 1.7 for a lamp of 3.8, and got dimmer with more training. The penalty's mean over noise of
    variance v is that of the noiseless difference plus v / 2 times its second derivative. Gradients flow only through
    the variance. Pixels brighter than a white truth have no penalty. The same idea, with two independent renderings:
    Deng et al. 2022, "Reconstructing Translucent Objects using Differentiable Rendering".

    The variance must be measured by independent groups of rays. Half of the spread of rays in separate cells is right
    on average, but then rewards ripples that cancel within a pixel, which grow on rough surfaces (docs/notes). The
    second derivative is evaluated as far out as the noise reaches: at 0, for a difference that is the mean of two large
    ones, it would reward noise without limit.
    """
    given = differences.detach()
    curvature = softness**2 / (given.square() + variance.detach() + softness**2) ** 1.5
    return torch.where(given == 0, 0.0, 0.5 * curvature * variance)


def _soft_mean(
    differences: Float32[Tensor, "pixel 3"], softness: float, variance: Float32[Tensor, "pixel 3"] | None
) -> Tensor:
    """Their mean absolute value; squared below `softness`, minus the bias from noise of a variance."""
    if not softness:  # Absolute values have no curvature: noise that is small beside them adds nothing.
        return differences.abs().mean()
    penalty = (differences.square() + softness**2).sqrt().mean() - softness
    return penalty if variance is None else penalty - noise_penalty(differences, variance, softness).mean()


def _mean_square(differences: Float32[Tensor, "pixel 3"], variance: Float32[Tensor, "pixel 3"] | None) -> Tensor:
    """The mean square of the differences, minus the variance of their noise: the loss of the sky.

    Where a rough surface mirrors a lamp, a few rays hit it and most miss, so a pixel's colour is mostly below its mean
    and sometimes far above. Charbonnier's penalty, which is linear there, is smallest at the *median*, and gradients
    reach the lamp only from the hits: it stays too dim, however exactly noise is subtracted. Squares are smallest at
    the mean, and noise adds exactly its variance to them. Textures keep the penalty: with squares they would follow
    noisy training pictures. Measured on `vitrine` and `plant_shelf` of `standard` (400 steps): the lamp of 3.5 is
    learned as 2.4 (1.2 by the penalty), and the worst extrapolating view of `vitrine` gains 4.0 dB.
    """
    assert variance is not None
    return SQUARES * torch.where(differences.detach() == 0, 0.0, differences.square() - variance).mean()
