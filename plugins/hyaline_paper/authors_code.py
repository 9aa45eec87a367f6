"""The renderer of `authors-code`: what the paper's released code really ran, to explain its published numbers.

Source: the public repository that the paper's author links (Mirjang/TransparentNeuralRendering): its renderer network,
its dispatcher (which drops the width that the scripts ask for, so that 64 is left) and its experiments' scripts.
"""

import dataclasses
import itertools
import zlib

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

from hyaline_paper.methods import LEAST_WIDTH, AuthorsConfig
from model.batches.rays import PixelSource, RayBatch
from model.methods.paper.renderer import default_texture_size
from model.methods.protocol import Inputs
from model.methods.renderer import PatchTerms, Renderer
from model.nets.pixel_mlp import ExtrinsicInputs, positions_for
from model.nets.texture import NeuralTextures, object_layout

LOSS_SCALE = 100 * 2
"""Their L1 has a weight of 100, on colours from -1 to 1. With Adam this only matters relative to weight decay."""

XAVIER_GAIN = 0.02
"""Their initial gain. Nothing is normalised, so every layer weakens the signal by a factor of 50 and training starts
slowly. Measured on the glass table at 128 pixels, pictures are still grey after 500 steps; they trained a million."""


class AuthorsBlock(nn.Module):
    """ReLU(x + f(x)) with dropout after both layers of f, then a layer that halves the channels."""

    def __init__(self, width: int, narrower: int) -> None:
        super().__init__()
        self.first = nn.Linear(width, width)
        self.second = nn.Linear(width, width)
        self.halve = nn.Linear(width, narrower)

    def forward(self, x: Float32[Tensor, "ray c"], dropout: float) -> Float32[Tensor, "ray c_half"]:
        inner = functional.relu(functional.dropout(self.first(x), dropout))
        x = functional.relu(x + functional.dropout(self.second(inner), dropout))
        return functional.relu(self.halve(x))


class AuthorsMlp(nn.Module):
    """Colours of pixels from their stacked layers: 33,267 parameters for 16 layers with view vectors."""

    def __init__(self, num_inputs: int, *, width: int, blocks: int) -> None:
        super().__init__()
        widths = [max(LEAST_WIDTH, width >> index) for index in range(blocks + 1)]
        self.first = nn.Linear(num_inputs, width)
        self.blocks = nn.ModuleList(AuthorsBlock(*pair) for pair in itertools.pairwise(widths))
        self.last = nn.Linear(widths[-1], 3)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_normal_(module.weight, gain=XAVIER_GAIN)
                nn.init.zeros_(module.bias)

    def forward(self, x: Float32[Tensor, "ray c"], dropout: float) -> Float32[Tensor, "ray 3"]:
        """Colours in (-1, 1), with a share `dropout` of the activations left out."""
        x = self.first(x)
        for block in self.blocks:
            x = block(x, dropout)
        return torch.tanh(self.last(x))


class AuthorsRenderer(Renderer[PixelSource[RayBatch]]):
    """Rays with layers in, sRGB colours of their pixels out."""

    def __init__(
        self, config: AuthorsConfig, *, num_layers: int, num_objects: int, positions: Float32[Tensor, "texel 3"] | None
    ) -> None:
        super().__init__()
        self.config = config
        features = config.texture_features + (9 if config.extrinsics == "sh" else 0)
        self.textures = NeuralTextures(
            object_layout((config.texture_size,) * num_objects), features, start=config.texture_start
        )
        self.extrinsics = (
            None
            if positions is None
            else ExtrinsicInputs("view", positions, num_objects=num_objects, size=config.position_size)
        )
        channels = features + (3 if config.extrinsics == "view" else 0)
        self.net = AuthorsMlp(num_layers * channels, width=config.width, blocks=config.blocks)

    def forward(self, rays: RayBatch, *, rng: np.random.Generator | None = None) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours in (0, 1) of the pixels.

        Args:
            rng: draws dropout while training; without it, dropout is drawn from the rays' uv, so that it repeats.
        """
        stack = self.textures(rays.uv, rays.object_id)
        if self.extrinsics is not None:
            away = -self.extrinsics(rays.uv, rays.object_id, rays.p_camera)
            if self.config.extrinsics == "view":
                stack = torch.cat([stack, away], dim=-1)
            else:
                turned = stack[..., 3:12] * harmonics_without_constants(away)
                stack = torch.cat([stack[..., :3], turned, stack[..., 12:]], dim=-1)
        seed = zlib.crc32(rays.uv.cpu().numpy().tobytes()) if rng is None else int(rng.integers(1 << 31))
        with torch.random.fork_rng(devices=[stack.device] if stack.is_cuda else []):
            torch.manual_seed(seed)
            colors = self.net(stack.flatten(1), self.config.dropout)
        return (colors + 1) / 2

    def loss(
        self,
        training: PixelSource[RayBatch],
        batch: int,
        rng: np.random.Generator,
        *,
        softness: float = 0.0,
        patch_terms: PatchTerms | None = None,
    ) -> Tensor:
        """The mean absolute difference of random pixels as the released code scales it.

        Their step uses one whole picture; this one draws as many pixels from all pictures.
        """
        return LOSS_SCALE * super().loss(training, batch, rng, softness=softness, patch_terms=patch_terms)


def harmonics_without_constants(direction: Float32[Tensor, "*b 3"]) -> Float32[Tensor, "*b 9"]:
    """The first three bands of spherical harmonics without their constants, as in the released code."""
    x, y, z = direction.unbind(-1)
    return torch.stack([torch.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], dim=-1)


def complete(config: AuthorsConfig, inputs: Inputs) -> AuthorsConfig:
    size = config.texture_size or default_texture_size(inputs.dataset.config.resolution.mean_side)
    return dataclasses.replace(config, texture_size=size)


def build(config: AuthorsConfig, inputs: Inputs) -> AuthorsRenderer:
    positions = positions_for(config.extrinsics, inputs.dataset, inputs.geometry, config.position_size)
    return AuthorsRenderer(
        config, num_layers=inputs.num_layers, num_objects=len(inputs.dataset.objects), positions=positions
    )
