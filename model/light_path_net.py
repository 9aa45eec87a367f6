"""Owns the method `light-path`: neural textures where light paths end, composited by the physics of glass."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor, nn
from torch.nn import functional

from datagen.dataset import Dataset
from datagen.errors import HyalineError
from model.extrinsics import spherical_harmonics
from model.texture import NeuralTextures

RESIDUAL_VERTICES = (4, 2)
"""Vertices of the refracted and of the mirror branch that the residual network sees."""


@dataclass(frozen=True, kw_only=True)
class LightPathConfig:
    """What our renderer is made of."""

    texture_size: int
    """Width and height of a texture in texels."""
    texture_features: int = 16
    hidden: int = 64
    """Units of the decoder's two hidden layers."""
    residual_hidden: int = 32
    """Units of the residual network's two hidden layers; 0 leaves it out."""
    environment_size: int = 32
    """Height in texels of the learned latitude-longitude map of the light from outside; it is twice as wide."""
    max_vertices: int = 8
    """Vertices traced in each branch."""
    train_samples: int = 4
    """Rays per pixel while training, a square number."""
    render_samples: int = 16
    """Rays per pixel while rendering, a square number."""

    def __post_init__(self) -> None:
        for name in ("texture_size", "texture_features", "hidden", "environment_size", "max_vertices"):
            if getattr(self, name) < 1:
                raise HyalineError(f"{name}: is {getattr(self, name)}; expected at least 1")
        for name in ("train_samples", "render_samples"):
            samples = getattr(self, name)
            if samples < 1 or math.isqrt(samples) ** 2 != samples:
                raise HyalineError(f"{name}: is {samples}; expected a square number of rays per pixel")


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPathBatch:
    """The light paths of some pixels: `samples` rays for each, pixel by pixel; vertices as in `LightPaths`."""

    samples: int
    object_id: UInt8[Tensor, "ray branch vertex"]
    """0 where there is no vertex."""
    uv: Float32[Tensor, "ray branch vertex 2"]
    throughput: Float32[Tensor, "ray branch vertex 3"]
    cosine: Float32[Tensor, "ray branch vertex"]
    """Of the angle between the arriving ray and the surface's normal, 0 to 1."""
    reflected: Float32[Tensor, "ray branch vertex 3"]
    """The arriving direction, mirrored at the surface."""
    is_end: Bool[Tensor, "ray branch vertex"]
    """True for the opaque vertex on which a branch ends."""
    end_direction: Float32[Tensor, "ray branch 3"]
    end_throughput: Float32[Tensor, "ray branch 3"]


class LightPathRenderer(nn.Module):
    """Light paths in, sRGB colours out.

    Radiance = sum over branches of throughput times what shines at the branch's end (a texel's decoded radiance, or
    the environment), averaged over the pixel's rays in linear light; plus a small non-negative residual from the
    stacked features of the first vertices, for the paths that are not traced. Edits stay valid: what is removed from
    the scene is no vertex of any path.
    """

    def __init__(self, config: LightPathConfig, *, num_objects: int) -> None:
        super().__init__()
        self.textures = NeuralTextures(
            num_objects, sharing="object", size=config.texture_size, features=config.texture_features
        )
        # Feature, cosine, spherical harmonics of the mirrored direction -> linear radiance.
        self.decoder = _mlp(config.texture_features + 1 + 9, config.hidden)
        self.environment = nn.Parameter(torch.zeros(3, config.environment_size, 2 * config.environment_size))
        per_vertex = config.texture_features + 2
        inputs = sum(RESIDUAL_VERTICES) * per_vertex
        self.residual = _mlp(inputs, config.residual_hidden) if config.residual_hidden else None

    def forward(self, paths: LightPathBatch, **_: object) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours of the pixels, at least 0."""
        count, branches, vertices = paths.object_id.shape
        features = self.textures(paths.uv.flatten(1, 2), paths.object_id.flatten(1, 2))
        features = features.view(count, branches, vertices, -1)

        # The ends on opaque surfaces.
        ends = paths.is_end.nonzero(as_tuple=True)
        inputs = torch.cat(
            [features[ends], paths.cosine[ends][:, None], spherical_harmonics(paths.reflected[ends])], dim=-1
        )
        shining = functional.softplus(self.decoder(inputs)) * paths.throughput[ends]
        radiance = torch.zeros(count, 3, device=shining.device).index_add(0, ends[0], shining)

        # The ends in the open.
        radiance = radiance + (self._environment(paths.end_direction) * paths.end_throughput).sum(dim=1)

        # What was not traced.
        if self.residual is not None:
            stack = torch.cat([features, paths.throughput.mean(-1, keepdim=True), paths.cosine[..., None]], dim=-1)
            seen = [stack[:, branch, :number].flatten(1) for branch, number in enumerate(RESIDUAL_VERTICES)]
            radiance = radiance + functional.softplus(self.residual(torch.cat(seen, dim=-1)) - 4)

        pixel = radiance.view(-1, paths.samples, 3).mean(dim=1)
        return srgb_curve(pixel)

    def _environment(self, direction: Float32[Tensor, "ray branch 3"]) -> Float32[Tensor, "ray branch 3"]:
        """Learned radiance from unit directions; whatever for the zero vector, whose throughput is 0."""
        x, y, z = direction.unbind(-1)
        # The map goes once around, so a column of the other end stands beside each end.
        padded = functional.pad(self.environment[None], (1, 1, 0, 0), mode="circular")
        width = self.environment.shape[2]
        azimuth = torch.atan2(y, x) / torch.pi  # -1 to 1.
        polar = 2 * torch.acos(z.clamp(-1, 1)) / torch.pi - 1
        place = torch.stack([azimuth * width / (width + 2), polar], dim=-1)
        texels = functional.grid_sample(padded, place[None], padding_mode="border", align_corners=False)
        return functional.softplus(texels[0].permute(1, 2, 0))


def build_light_path(config: LightPathConfig, dataset: Dataset, geometry: str, num_layers: int) -> LightPathRenderer:  # noqa: ARG001
    """A fresh renderer for a dataset; its random start is drawn from torch's default generator."""
    return LightPathRenderer(config, num_objects=len(dataset.objects))


def srgb_curve(linear: Float32[Tensor, "*b"]) -> Float32[Tensor, "*b"]:
    """The sRGB curve of values >= 0, going on above 1 so that gradients do. Source: IEC 61966-2-1."""
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


def _mlp(num_inputs: int, hidden: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(num_inputs, hidden),
        nn.LeakyReLU(0.2),
        nn.Linear(hidden, hidden),
        nn.LeakyReLU(0.2),
        nn.Linear(hidden, 3),
    )
