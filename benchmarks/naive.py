"""The task of the network benchmarks (synthetic layers, the renderer `paper`), and the naive baseline.

The baseline is the renderer as one writes it first, with equal weights: a `grid_sample` for each object and layer,
masked and summed, then 1x1 convolutions on images of channels.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.choices import BenchChoices
from datagen.data.cameras import Cameras
from datagen.data.layers import UV_SCALE
from model.batches.layers import Pixels
from model.batches.rays import RayBatch
from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer, count_inputs
from model.nets.pixel_mlp import LEAKY_SLOPE, LinearUnit, ResidualBlock, width_for_34k
from model.nets.texture import NeuralTextures

COVERED = 0.4
"""Share of all (pixel, layer) places that hold a surface, in scenes of transparent objects."""


@dataclass(frozen=True, kw_only=True)
class Ball:
    """A ball in the unit square of a picture; its far side is a layer, too."""

    center: tuple[float, float]
    radius: float
    depth: float
    turn: float
    """Rotation of its texture in radians."""


def made_up_frame(choices: BenchChoices, *, rng: np.random.Generator) -> Pixels:
    """One view of balls, with two layers each, as `Pixels` keep it; black.

    Neighbouring pixels meet neighbouring texels, and about `COVERED` of all places hold a surface.
    """
    num_layers, side = choices.layers, choices.resolution
    place = np.stack(np.meshgrid(*[(np.arange(side) + 0.5) / side] * 2), axis=-1).reshape(-1, 2)
    # As many hits as are wanted if balls were never cut off by the picture's edge, nor lists by their end.
    radius = np.sqrt(1.35 * COVERED * num_layers / (2 * np.pi * choices.objects))
    uv = np.zeros((len(place), 2 * choices.objects, 2))
    depth = np.full((len(place), 2 * choices.objects), np.inf)
    for index in range(choices.objects):
        ball = Ball(
            center=tuple(rng.random(2)),
            radius=radius * rng.uniform(0.7, 1.3),
            depth=rng.random(),
            turn=rng.random() * 2 * np.pi,
        )
        inside, sides = _meet(ball, place)
        for far, (at, distance) in enumerate(sides):
            uv[inside, 2 * index + far], depth[inside, 2 * index + far] = at, distance
    order = np.argsort(depth, axis=1)[:, :num_layers]
    found = np.isfinite(np.take_along_axis(depth, order, axis=1))
    uv = np.take_along_axis(uv, order[..., None], axis=1) * found[..., None]
    return Pixels(
        uv=torch.from_numpy(np.rint(uv * UV_SCALE).astype(np.uint16).view(np.int16)),
        object_id=torch.from_numpy(np.where(found, order // 2 + 1, 0).astype(np.uint8)),
        rgb=torch.zeros(len(place), 3, dtype=torch.uint8),
        cameras=Cameras(width=side, height=side, fov_x=1.0, world_from_camera=np.eye(4)[None]),
    )


def _meet(ball: Ball, place: Float[np.ndarray, "pixel 2"]) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """The pixels that show a ball, with uv and depth on its near and far side."""
    x, y = (place - ball.center).T / ball.radius
    inside = np.nonzero(x * x + y * y < 1)[0]
    x, y = x[inside], y[inside]
    x, y = np.cos(ball.turn) * x - np.sin(ball.turn) * y, np.sin(ball.turn) * x + np.cos(ball.turn) * y
    z = np.sqrt(1 - x * x - y * y)
    v = np.arcsin(y) / np.pi + 0.5
    sides = []
    for toward in (1, -1):
        u = np.arctan2(x, toward * z) / (2 * np.pi) + 0.5
        sides.append((np.stack([u, v], axis=-1), ball.depth - toward * ball.radius * z))
    return inside, sides


def made_up_batch(choices: BenchChoices, *, rng: np.random.Generator) -> tuple[RayBatch, Float32[Tensor, "pixel 3"]]:
    """Random pixels of four frames, as a training step draws them, and colours to learn."""
    frames = [made_up_frame(choices, rng=rng) for _ in range(4)]
    index = torch.from_numpy(rng.integers(choices.resolution**2, size=-(-choices.pixels // 4)))
    parts = [frame.take(index, None) for frame in frames]
    rays = RayBatch(
        uv=torch.cat([part.uv for part in parts])[: choices.pixels],
        object_id=torch.cat([part.object_id for part in parts])[: choices.pixels],
        p_camera=torch.cat([part.p_camera for part in parts])[: choices.pixels],
    )
    return rays, torch.from_numpy(rng.random((choices.pixels, 3), np.float32))


def make_renderer(choices: BenchChoices, *, rng: np.random.Generator) -> PaperRenderer:
    """The product's renderer, without the camera as an input; textures and batch norm as if it had been trained."""
    inputs = count_inputs(choices.layers, texture_features=choices.features, extrinsics="none", zero_layer=False)
    config = PaperConfig(
        width=width_for_34k(inputs),
        texture_size=choices.texture_size,
        texture_features=choices.features,
        extrinsics="none",
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(1 << 31)))
        renderer = PaperRenderer(config, num_layers=choices.layers, num_objects=choices.objects, positions=None)
        with torch.no_grad():
            renderer.textures.get_parameter("table").copy_(smooth_texels(choices))
            for module in renderer.modules():
                if isinstance(module, nn.BatchNorm1d):
                    module.weight.uniform_(0.5, 1.5)
                    module.bias.normal_(std=0.2)
                    assert module.running_mean is not None
                    assert module.running_var is not None
                    module.running_mean.normal_(std=0.2)
                    module.running_var.uniform_(0.5, 1.5)
    return renderer


def smooth_texels(choices: BenchChoices) -> Float32[Tensor, "texel c"]:
    """Random features of all objects that change over eight texels, as learned ones do."""
    size = choices.texture_size
    coarse = torch.randn(choices.objects, choices.features, *[max(2, size // 8)] * 2)
    fine = functional.interpolate(coarse, size=(size, size), mode="bilinear", align_corners=False)
    return fine.permute(0, 2, 3, 1).reshape(-1, choices.features)


def describe(choices: BenchChoices, renderer: PaperRenderer) -> dict[str, object]:
    """The settings for the header of a report."""
    num_parameters = sum(parameter.numel() for parameter in renderer.net.parameters())
    return {
        "objects": choices.objects,
        "layers": choices.layers,
        "texture": f"{choices.texture_size} x {choices.texture_size} x {choices.features}",
        "network": f"{num_parameters:,} parameters",
        "threads": torch.get_num_threads(),
    }


def relative_error(found: Tensor, expected: Tensor) -> float:
    """The largest difference, as a share of the largest expected value."""
    found, expected = found.detach().float(), expected.detach().float()
    return float((found - expected).abs().max() / expected.abs().max().clamp_min(1e-30))


def relative_distance(found: Tensor, expected: Tensor) -> float:
    """The length of the difference, as a share of the expected length."""
    found, expected = found.detach().float(), expected.detach().float()
    return float((found - expected).norm() / expected.norm().clamp_min(1e-30))


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
