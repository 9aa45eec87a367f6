"""The renderer of `paper`: neural textures on straight layers, stacked into a per-pixel residual MLP."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from datagen.data.cameras import Cameras
from model.batches.layers import trace_cameras
from model.batches.rays import PixelSource, RayBatch, insert_empty_layer, linear_curve, srgb_curve
from model.methods.paper.config import PaperConfig
from model.methods.protocol import Inputs
from model.methods.renderer import Renderer
from model.nets.pixel_mlp import ExtrinsicInputs, PixelMlp, positions_for, width_for_34k
from model.nets.texture import NeuralTextures, TexturePyramid, object_layout
from model.settings import EXTRINSIC_CHANNELS, Extrinsics

if TYPE_CHECKING:
    from datagen.scene.description import Scene
    from model.methods.page import MethodPage

START_ALONE = 0.5
"""Initial texel value when textures are the network's only input (the authors' code always uses it). From zeros the
first batch norm would divide by a tiny spread, amplify the signs of the first steps, and leave blotches on walls:
measured on the glass table at 128 pixels after 1,200 steps, 23.4 dB on held-out views; 27.4 from one half."""


def default_texture_size(side: int, texels_per_pixel: float = 0.5) -> int:
    """Half the side of a square image for each object, as the authors ran it: 256 texels for frames of 512 pixels.

    With more, the texels of small objects are seen so rarely that they memorise single pixels: at 128 pixels, 256
    texels cost 1.9 dB (interpolating) and 1.1 dB (extrapolating) against 64. (A pyramid of textures does not.)

    Args:
        side: side of the square with as many pixels as an image.
    """
    return max(16, int(side * texels_per_pixel))


def count_inputs(num_layers: int, *, texture_features: int, extrinsics: Extrinsics, zero_layer: bool) -> int:
    """Inputs of the network: features and extrinsics of all layers, the zero layer included."""
    return (num_layers + zero_layer) * (texture_features + EXTRINSIC_CHANNELS[extrinsics])


class PaperRenderer(Renderer[PixelSource[RayBatch]]):
    """Rays with layers in, sRGB colours of their pixels out."""

    def __init__(
        self, config: PaperConfig, *, num_layers: int, num_objects: int, positions: Float32[Tensor, "texel 3"] | None
    ) -> None:
        super().__init__()
        self.zero_layer = config.zero_layer
        sizes = [max(2, config.texture_size >> level) for level in range(config.texture_levels)]
        layouts = [object_layout((size,) * num_objects) for size in sizes]
        start = START_ALONE if config.extrinsics == "none" else 0.0
        self.textures = (
            NeuralTextures(layouts[0], config.texture_features, start=start)
            if len(layouts) == 1
            else TexturePyramid(layouts, config.texture_features, finer_counts=config.finer_counts, start=start)
        )
        self.extrinsics = (
            None
            if positions is None
            else ExtrinsicInputs(config.extrinsics, positions, num_objects=num_objects, size=config.position_size)
        )
        num_inputs = count_inputs(
            num_layers,
            texture_features=config.texture_features,
            extrinsics=config.extrinsics,
            zero_layer=config.zero_layer,
        )
        self.net = PixelMlp(num_inputs, width=config.width, blocks=config.blocks, norm=config.norm)

    def forward(self, rays: RayBatch, *, rng: np.random.Generator | None = None) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours of the pixels, about [0, 1]; several rays of a pixel are averaged in linear light.

        Args:
            rng: draws the place of each ray's zero layer while training; without it that layer comes last.
        """
        if self.zero_layer:
            rays = insert_empty_layer(rays, rng)
        stack = self.textures(rays.uv, rays.object_id)
        if self.extrinsics is not None:
            inputs = self.extrinsics(rays.uv, rays.object_id, rays.p_camera)
            stack = torch.cat([stack, inputs], dim=-1)
        colors = self.net(stack.flatten(1))
        if rays.samples == 1:
            return colors
        return srgb_curve(linear_curve(colors).view(-1, rays.samples, 3).mean(dim=1))


def complete(config: PaperConfig, inputs: Inputs) -> PaperConfig:
    """The same with the widths of network and texture that depend on the dataset."""
    num_inputs = count_inputs(
        inputs.num_layers,
        texture_features=config.texture_features,
        extrinsics=config.extrinsics,
        zero_layer=config.zero_layer,
    )
    side = inputs.dataset.config.resolution.mean_side
    size = config.texture_size or default_texture_size(side, config.texels_per_pixel)
    width = config.width or width_for_34k(num_inputs)
    return dataclasses.replace(config, width=width, texture_size=size)


def build(config: PaperConfig, inputs: Inputs) -> PaperRenderer:
    positions = positions_for(config.extrinsics, inputs.dataset, inputs.geometry, config.position_size)
    return PaperRenderer(
        config, num_layers=inputs.num_layers, num_objects=len(inputs.dataset.objects), positions=positions
    )


def load_cameras(config: PaperConfig, inputs: Inputs, cameras: Cameras) -> PixelSource[RayBatch]:
    return trace_cameras(
        inputs.dataset,
        inputs.geometry,
        inputs.num_layers,
        cameras,
        train_samples=config.train_samples,
        render_samples=config.render_samples,
    )


def draw_page(config: PaperConfig, renderer: PaperRenderer, scene: "Scene") -> "MethodPage":  # noqa: ARG001
    """The renderer without the layer of zeros after all others, which changes nothing."""
    from model.methods.page import MethodPage, feature_columns, layer_rows, package_text  # Training needs no page.

    features, extrinsics = config.texture_features, EXTRINSIC_CHANNELS[config.extrinsics]
    (first_weight, first_bias), *others = renderer.net.folded()
    channels = features + extrinsics
    num_layers = first_weight.shape[1] // channels - config.zero_layer
    columns = [at for layer in range(num_layers) for at in feature_columns(features, extrinsics, layer * channels)]
    return MethodPage(
        shader=package_text("model.methods.paper", "paper.glsl"),
        defines={"LAYERS_SEEN": num_layers, "EXTRINSICS": extrinsics, "WIDTH": config.width, "BLOCKS": config.blocks},
        textures=renderer.textures,
        weights=[
            *layer_rows(first_weight, first_bias, columns),
            *(rows for weight, bias in others for rows in layer_rows(weight, bias)),
        ],
        samples=config.render_samples,
    )
