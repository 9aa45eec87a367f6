"""What a method learns: a torch module that makes pixels' colours, and says what training makes small."""

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from model.batches.rays import PixelSource
from model.losses.pixel_losses import PatchTerms, pixel_loss
from model.nets.texture import NeuralTextures
from model.settings.optimisation import Optimisation

SourceT = TypeVar("SourceT", bound=PixelSource)


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterGroup:
    """Parameters that learn at one rate."""

    parameters: list[nn.Parameter]
    lr: float
    weight_decay: float = 0.0
    counts_as: Literal["network", "textures", "helper"] = "network"
    """Where tables count them; a helper (a discriminator) is not needed to render, and is not counted."""


class Renderer(nn.Module, Generic[SourceT]):
    """Pixels in, sRGB colours out; `SourceT` is what the method's `load` gives.

    A method implements `forward(batch, *, rng=None)`: what `SourceT.take` made of some pixels in, their sRGB colours
    (pixel, 3), about [0, 1], out; `rng` is there while training only. All state lies in parameters and buffers.
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
        """What a step makes small on about `batch` training pixels; whatever is random is drawn by `rng`.

        Args:
            softness: of `LossConfig`.
            patch_terms: further losses to add, where the method's `optimisation` takes their flags.
        """
        return pixel_loss(self, training, batch, rng, softness=softness, patch_terms=patch_terms)

    def finish(self, training: SourceT, *, batch: int, updates: int, rng: np.random.Generator) -> None:  # noqa: ARG002
        """What is left to do after the last of `updates` weight updates, each from `batch` pixels: mostly nothing."""
        return

    def render(self, pixels: SourceT) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours of all pixels, neither clipped nor rounded; called at evaluation, without gradients."""
        index = torch.arange(len(pixels.rgb), device=pixels.rgb.device)
        return torch.cat([self(pixels.take(part, None)) for part in index.split(pixels.chunk)])

    def groups(self, optimisation: Optimisation) -> list[ParameterGroup]:
        """All parameters, by the rates at which they learn."""
        textures = self.parameters_of(NeuralTextures)
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

    def parameters_of(self, kind: type[nn.Module]) -> list[nn.Parameter]:
        """The parameters of all parts of a kind, in the order in which the renderer has them."""
        return [value for part in self.modules() if isinstance(part, kind) for value in part.parameters()]

    def all_but(self, others: list[nn.Parameter]) -> list[nn.Parameter]:
        """The parameters that are none of these."""
        apart = {id(value) for value in others}
        return [value for value in self.parameters() if id(value) not in apart]
