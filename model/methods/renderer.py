"""A method's renderer: a torch module that computes pixels' colours, and its loss on random training pixels."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float32, Int
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
from model.nets.texture import NeuralTextures
from model.settings import Optimisation

SourceT = TypeVar("SourceT", bound=PixelSource)


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterGroup:
    """Parameters that learn at one rate."""

    parameters: list[nn.Parameter]
    lr: float
    weight_decay: float = 0.0
    eps: float = 1e-8
    """Adam's: the size of gradients below which parameters move more slowly."""
    counts_as: Literal["network", "textures", "helper"] = "network"
    """The column of tables that counts them; a helper (a discriminator) is not needed to render, and is not counted."""


@dataclass(frozen=True, kw_only=True)
class PatchTerms:
    """Loss terms on patches: how many to draw, and the weighted sum of the terms for (predicted, true)."""

    size: int
    number: int
    of: Callable[[Float32[Tensor, "patch row column 3"], Float32[Tensor, "patch row column 3"]], Tensor]


class Renderer(nn.Module, Generic[SourceT]):
    """Pixels in, sRGB colours out; `SourceT` is what the method's `load` gives.

    A method implements `forward(batch, *, rng=None)`: from the result of `SourceT.take` for some pixels to their sRGB
    colours (pixel, 3), about [0, 1]; `rng` is given in training only. All state lies in parameters and buffers.
    """

    def loss(
        self,
        training: SourceT,
        batch: int,
        rng: np.random.Generator,
        *,
        softness: float = 0.0,
        patch_terms: PatchTerms | None = None,
    ) -> Tensor:
        """The loss of a step on about `batch` training pixels; all randomness comes from `rng`.

        Args:
            softness: see `LossConfig`.
            patch_terms: further losses to add, if the method's `optimisation` has their flags.
        """
        return pixel_loss(self, training, batch, rng, softness=softness, patch_terms=patch_terms)

    def finish(self, training: SourceT, *, batch: int, updates: int, rng: np.random.Generator) -> None:  # noqa: ARG002
        """A hook after the last of `updates` weight updates, each from `batch` pixels; does nothing by default."""
        return

    def render(self, pixels: SourceT, index: Int[Tensor, " pixel"] | None = None) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours of pixels, neither clipped nor rounded; called at evaluation, without gradients.

        Args:
            index: row numbers, those of whole views if `pixels.whole_views`; None: all.
        """
        device = pixels.rgb.device
        rows = torch.arange(len(pixels.rgb), device=device) if index is None else index.to(device)
        return torch.cat([self(pixels.take(part, None)) for part in rows.split(pixels.chunk)])

    def groups(self, optimisation: Optimisation) -> list[ParameterGroup]:
        """All parameters, grouped by learning rate."""
        textures = [value for part in self.modules() if isinstance(part, NeuralTextures) for value in part.parameters()]
        return [
            ParameterGroup(
                parameters=self.all_but(textures), lr=optimisation.lr, weight_decay=optimisation.weight_decay
            ),
            ParameterGroup(
                parameters=textures,
                lr=optimisation.lr if optimisation.texture_lr is None else optimisation.texture_lr,
                counts_as="textures",
            ),
        ]

    def all_but(self, others: list[nn.Parameter]) -> list[nn.Parameter]:
        """All parameters except these."""
        apart = {id(value) for value in others}
        return [value for value in self.parameters() if id(value) not in apart]


Radiance = Callable[..., tuple[Float32[Tensor, "pixel sample 3"], Float32[Tensor, "pixel sample 3"] | None]]
"""Linear radiance of every ray of a batch, and the same numbers again with only the sky's gradients. Without the
second, the first has all gradients."""

SQUARES = 10.0
"""Weight of the sky's squared errors: near 0 it equals Charbonnier's penalty of softness 0.05."""


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
    taken, truth = training.take(together, rng), take_colors(training, together)
    if not debias or radiance is None:
        colors = renderer(taken, rng=rng)
        loss = _soft_mean(difference(colors[:batch], truth[:batch]), softness)
    else:
        parts = [part for part in radiance(taken) if part is not None]
        rays = torch.cat(parts)  # On a GPU, each operation is a launch.
        values = mean_color(rays), debias * variance_of_mean(rays)
        (colors, *of_sky), (noise, *noise_of_sky) = (value.unflatten(0, (len(parts), -1)).unbind() for value in values)
        missed = difference(colors[:batch], truth[:batch])
        loss = _soft_mean(missed, softness)
        if softness:  # Absolute values have no curvature: noise that is small beside them adds nothing.
            loss = loss - noise_penalty(missed, noise[:batch], softness).mean()
        for color, variance in zip(of_sky, noise_of_sky):  # Adds gradients, but nothing to the value.
            squares = mean_square(difference(color[:batch], truth[:batch]), variance[:batch])
            loss = loss + (squares - squares.detach())
    if patch_terms is None or patches is None:
        return loss
    shape = (*patches.shape, 3)
    return loss + patch_terms.of(colors[batch:].view(shape), truth[batch:].view(shape))


def _soft_mean(differences: Float32[Tensor, "pixel 3"], softness: float) -> Tensor:
    """Their mean absolute value; squared below `softness`."""
    return (differences.square() + softness**2).sqrt().mean() - softness if softness else differences.abs().mean()


def difference(colors: Float32[Tensor, "*b 3"], truth: Float32[Tensor, "*b 3"]) -> Float32[Tensor, "*b 3"]:
    """Predicted minus true sRGB; 0 where the truth is white and the prediction is brighter.

    Pictures clip: pulling a lamp of radiance 4 down to 1 would dim its reflections in glass, which are not clipped.
    """
    missed = colors - truth
    return torch.where(truth < 1, missed, missed.clamp_max(0))


def noise_penalty(
    differences: Float32[Tensor, "pixel 3"], variance: Float32[Tensor, "pixel 3"], softness: float
) -> Float32[Tensor, "pixel 3"]:
    """The bias that noise of a variance adds to Charbonnier's penalty of the differences, to second order.

    Squares penalise noise like error: a renderer learns to dim lamps and to blur textures, because less variation
    between rays costs less. The penalty's mean over noise of variance v is that of the noiseless difference plus v / 2
    times its second derivative. Gradients flow only through the variance. Pixels brighter than a white truth have no
    penalty. The same idea: Deng et al. 2022, "Reconstructing Translucent Objects using Differentiable Rendering".

    The variance must be measured by independent groups of rays, or ripples that cancel within a pixel are rewarded. The
    second derivative is evaluated as far out as the noise reaches: at 0, it could reward noise without limit.
    """
    given = differences.detach()
    curvature = softness**2 / (given.square() + variance.detach() + softness**2) ** 1.5
    return torch.where(given == 0, 0.0, 0.5 * curvature * variance)


def mean_square(differences: Float32[Tensor, "pixel 3"], variance: Float32[Tensor, "pixel 3"]) -> Tensor:
    """The mean square of the differences, minus the variance of their noise: the loss of the sky.

    Where a rough surface mirrors a lamp, few rays hit it, so a pixel's colour is mostly below its mean. Charbonnier's
    penalty is smallest at the *median*, squares at the mean, and noise adds exactly its variance to them. Textures keep
    the penalty: with squares they would follow noisy training pictures.
    """
    return SQUARES * torch.where(differences.detach() == 0, 0.0, differences.square() - variance).mean()
