"""The baseline of the benchmarks: the renderer `paper` as one writes it first, with equal weights.

A `grid_sample` for each object and layer, masked and summed, then 1x1 convolutions on images of channels. Nothing in
the product uses it.
"""

import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

from model.batches.rays import RayBatch
from model.methods.paper.renderer import PaperRenderer
from model.nets.pixel_mlp import LEAKY_SLOPE, LinearUnit, ResidualBlock
from model.nets.texture import NeuralTextures


def conv_of(linear: nn.Linear) -> nn.Conv2d:
    """The 1x1 convolution that does what a linear layer does."""
    conv = nn.Conv2d(linear.in_features, linear.out_features, 1)
    conv.load_state_dict({"weight": linear.weight[:, :, None, None], "bias": linear.bias})
    return conv


def unit_of(unit: LinearUnit) -> nn.Sequential:
    """Convolution, batch norm if there is one, LeakyReLU."""
    parts: list[nn.Module] = [conv_of(unit.linear)]
    if isinstance(unit.norm, nn.BatchNorm1d):
        norm = nn.BatchNorm2d(unit.linear.out_features)
        norm.load_state_dict(unit.norm.state_dict())
        parts.append(norm)
    return nn.Sequential(*parts, nn.LeakyReLU(LEAKY_SLOPE))


class NaiveBlock(nn.Module):
    """Two units whose input is added to their output, then a unit that halves the channels."""

    def __init__(self, block: ResidualBlock) -> None:
        super().__init__()
        self.first, self.second, self.halve = unit_of(block.first), unit_of(block.second), unit_of(block.halve)

    def forward(self, x: Float32[Tensor, "b c h w"]) -> Float32[Tensor, "b c_half h w"]:
        return self.halve(x + self.second(self.first(x)))


class NaiveRenderer(nn.Module):
    """Rays with layers in, sRGB colours of their pixels out: what a `PaperRenderer` computes, with its weights."""

    def __init__(self, renderer: PaperRenderer) -> None:
        super().__init__()
        assert isinstance(renderer.textures, NeuralTextures)
        layout = renderer.textures.layout
        size = layout.sizes[0]
        images = renderer.textures.table.detach().view(len(layout.sizes), size, size, -1).permute(0, 3, 1, 2)
        self.images = nn.ParameterList([image[None].clone() for image in images])
        net = renderer.net
        blocks = [NaiveBlock(block) for block in net.residual_blocks()]
        self.net = nn.Sequential(unit_of(net.first), *blocks, conv_of(net.last))

    def sample(self, rays: RayBatch) -> Float32[Tensor, "1 c h w"]:
        """The stack of all layers' features, as an image of one row."""
        layers = []
        for layer in range(rays.object_id.shape[1]):
            uv, object_id = rays.uv[None, None, :, layer], rays.object_id[None, None, None, :, layer]
            grid = torch.stack([2 * uv[..., 0] - 1, 1 - 2 * uv[..., 1]], dim=-1)
            features = torch.zeros(1, 1, device=grid.device)
            for index, image in enumerate(self.images):
                found = functional.grid_sample(image, grid, padding_mode="border", align_corners=False)
                features = features + found * (object_id == index + 1)
            layers.append(features)
        return torch.cat(layers, dim=1)

    def forward(self, rays: RayBatch) -> Float32[Tensor, "pixel 3"]:
        return self.net(self.sample(rays))[0, :, 0].T

    def texture_gradient(self) -> Float32[Tensor, "texel c"]:
        """The gradient of all textures, in the order of the product's table."""
        gradients = [image.grad for image in self.images if image.grad is not None]
        return torch.cat([gradient[0].flatten(1).T for gradient in gradients])
