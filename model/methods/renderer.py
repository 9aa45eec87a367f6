"""A method's renderer: a torch module that computes pixels' colours and the training loss."""

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float32, Int
from torch import Tensor, nn

from model.batches.rays import PixelSource
from model.methods.pixel_losses import PatchTerms, pixel_loss
from model.nets.texture import NeuralTextures
from model.settings import Optimisation

SourceT = TypeVar("SourceT", bound=PixelSource)


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterGroup:
    """Parameters that learn at one rate."""

    parameters: list[nn.Parameter]
    lr: float
    weight_decay: float = 0.0
    counts_as: Literal["network", "textures", "helper"] = "network"
    """The column of tables that counts them; a helper (a discriminator) is not needed to render, and is not counted."""


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
        """The parameters of all submodules of a kind, in the renderer's order."""
        return [value for part in self.modules() if isinstance(part, kind) for value in part.parameters()]

    def all_but(self, others: list[nn.Parameter]) -> list[nn.Parameter]:
        """All parameters except these."""
        apart = {id(value) for value in others}
        return [value for value in self.parameters() if id(value) not in apart]
