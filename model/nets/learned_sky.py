"""The learned sky: light from outside of the scene, as radiance by direction."""

import itertools
import math
from collections.abc import Sequence
from typing import cast

import numba
import numpy as np
import torch
from jaxtyping import Float32, Int
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx
from torch.nn import functional

from datagen.machine.compiled import compiled
from model.nets.texture import constant_on, level_scales, sum_texels, taps_around

LOBE_RATE = 2.5
"""Learning rate of the lobes relative to the maps: they are few numbers, each constrained by many rays."""

DARKEST = 1e-3
"""Least radiance of a map that starts from what was seen."""

LOBE_SHARPNESS = 6.0
"""Initial sharpness of a lobe: it falls to half its brightness at 28 degrees."""


class LearnedSky(nn.Module):
    """The radiance of a direction: a sum of latitude-longitude maps, finest first, plus lobes.

    The finest map is `height` texels high and twice as wide; each further one is half as large, down to a single
    colour, and counts 1 / `finer_counts` as much, so directions without training rays are filled in from nearby ones.
    For bright lamps, maps would need a high learning rate, and would then drift where they are unconstrained. So
    spherical Gaussians learn direction, width and colour of lamps.
    """

    def __init__(self, height: int, lobes: int, finer_counts: float) -> None:
        super().__init__()
        self.finer_counts = finer_counts
        for level, size in enumerate(_map_sizes(height)):
            self.register_parameter(str(level), nn.Parameter(torch.zeros(3, *size)))
        self.num_maps = len(_map_sizes(height))
        self.lobes = SkyLobes(lobes) if lobes else None

    @property
    def maps(self) -> list[nn.Parameter]:
        """Each (3, rows, columns), finest first."""
        return [self.get_parameter(str(level)) for level in range(self.num_maps)]

    def forward(self, direction: Float32[Tensor, "exit 3"]) -> Float32[Tensor, "exit 3"]:
        """Radiance from unit directions; arbitrary for the zero vector, whose throughput is 0."""
        soft = functional.softplus(self._before_softplus(*_angles(direction), first=0))
        return soft if self.lobes is None else soft + self.lobes(direction)

    @torch.no_grad()
    def start_from(self, direction: Float32[Tensor, "ray 3"], radiance: Float32[Tensor, "ray 3"]) -> None:
        """Sets the maps to what was seen in some directions, with the lobes as they are.

        Each map adds what coarser ones lack, in texels that were seen; a step of training moves a texel by little, and
        few rays meet each of the finest.
        """
        rest = radiance if self.lobes is None else radiance - self.lobes(direction)
        scales = level_scales(self.num_maps, self.finer_counts)
        for level in reversed(range(self.num_maps)):
            texels = self.maps[level]
            _, height, width = texels.shape
            place = self.texels_at(level, direction)
            count = torch.bincount(place, minlength=height * width).clamp(min=1e-9)
            mean = torch.zeros(height * width, 3).index_add(0, place, rest) / count[:, None]
            mean = mean.clamp(min=DARKEST)
            wanted = mean + torch.log(-torch.expm1(-mean))  # The softplus of it is the mean.
            at = torch.arange(height * width)
            middle = (2 * (at % width) + 1) / width - 1, (2 * (at // width) + 1) / height - 1
            lack = (wanted - self._before_softplus(*middle, first=level + 1)) / scales[level]
            texels.copy_(torch.where((count >= 1)[:, None], lack, 0).T.reshape(3, height, width))

    def texels_at(self, level: int, direction: Float32[Tensor, "ray 3"]) -> Int[Tensor, " ray"]:
        """Which texels of a map unit directions fall in, counted row by row."""
        _, height, width = self.maps[level].shape
        azimuth, polar = _angles(direction)
        row, column = ((polar + 1) / 2 * height).long(), ((azimuth + 1) / 2 * width).long()
        return row.clamp(max=height - 1) * width + column.clamp(max=width - 1)

    def _before_softplus(
        self, azimuth: Float32[Tensor, " exit"], polar: Float32[Tensor, " exit"], *, first: int
    ) -> Float32[Tensor, "exit 3"]:
        """The sum of the maps from the `first` on."""
        if first == self.num_maps:
            return torch.zeros(len(azimuth), 3, device=azimuth.device)
        maps, scales = self.maps[first:], level_scales(self.num_maps, self.finer_counts)[first:]
        if azimuth.device.type != "cpu":
            return _sum_of_maps(maps, scales, azimuth, polar)
        return cast(Tensor, _CompiledSky.apply(scales, torch.stack([azimuth, polar]), *maps))


class SkyLobes(nn.Module):
    """Spherical Gaussians: lamps with learned direction, width and radiance."""

    def __init__(self, count: int) -> None:
        super().__init__()
        # Spread evenly over the sphere, on a Fibonacci spiral.
        place = torch.arange(count) + 0.5
        z = 1 - 2 * place / count
        azimuth = math.pi * (1 + math.sqrt(5)) * place
        radius = torch.sqrt(1 - z * z)
        axis = torch.stack([radius * torch.cos(azimuth), radius * torch.sin(azimuth), z], dim=1)
        self.axis = nn.Parameter(axis / LOBE_RATE)
        self.sharpness = nn.Parameter(torch.zeros(count))
        self.brightness = nn.Parameter(torch.full((count, 3), -1 / LOBE_RATE))

    def forward(self, direction: Float32[Tensor, "exit 3"]) -> Float32[Tensor, "exit 3"]:
        """Radiance from unit directions."""
        axis = functional.normalize(self.axis, dim=1)
        sharpness = LOBE_SHARPNESS * torch.exp(LOBE_RATE * self.sharpness)
        falloff = torch.exp(sharpness * (direction @ axis.T - 1))
        return falloff @ functional.softplus(3 * LOBE_RATE * self.brightness)


def _map_sizes(height: int) -> list[tuple[int, int]]:
    """Heights and widths of the maps of the sky: twice as wide as high, then halved down to a single texel."""
    return [*((height >> level, 2 * height >> level) for level in range(height.bit_length())), (1, 1)]


def _angles(direction: Float32[Tensor, "exit 3"]) -> tuple[Float32[Tensor, " exit"], Float32[Tensor, " exit"]]:
    """Azimuth and polar angle of unit directions, both from -1 to 1."""
    x, y, z = direction.unbind(-1)
    return torch.atan2(y, x) / torch.pi, 2 * torch.acos(z.clamp(-1, 1)) / torch.pi - 1


def _wrapped(texels: Float32[Tensor, "3 tex_h tex_w"]) -> Float32[Tensor, "3 tex_h further"]:
    """A map that goes once around, whose ends get a column from the other end."""
    width = texels.shape[2]
    return texels.index_select(2, constant_on((width - 1, *range(width), 0), torch.int32, texels.device))


@numba.njit
def _taps(place, texels, ray):
    """Rows and columns of the four texels of a map around a ray's place, and the share of the later ones: the map goes
    once around, and its first and last rows go on to the poles."""
    height, width = texels.shape[1:]
    x = (place[0, ray] + np.float32(1)) / np.float32(2) * np.float32(width) - np.float32(0.5)
    y = (place[1, ray] + np.float32(1)) / np.float32(2) * np.float32(height) - np.float32(0.5)
    y = min(max(y, np.float32(0)), np.float32(height - 1))
    left, top = np.int32(np.floor(x)), min(max(np.int32(y), 0), height - 1)  # Inside the map even where y is NaN.
    columns = (left + width) % width, (left + 1) % width
    return (top, min(top + 1, height - 1)), columns, y - np.float32(top), x - np.float32(left)


@compiled(boundscheck=False)
def _add_map(
    result: Float32[np.ndarray, "ray 3"],
    texels: Float32[np.ndarray, "3 tex_h tex_w"],
    place: Float32[np.ndarray, "2 ray"],
    scale: np.float32,
) -> None:
    """Adds `scale` times a latitude-longitude map at each ray's azimuth and polar angle, both from -1 to 1."""
    for ray in range(len(result)):
        (top, bottom), (left, right), y, x = _taps(place, texels, ray)
        for c in range(3):
            upper = (1 - x) * texels[c, top, left] + x * texels[c, top, right]
            lower = (1 - x) * texels[c, bottom, left] + x * texels[c, bottom, right]
            result[ray, c] += scale * ((1 - y) * upper + y * lower)


@compiled(boundscheck=False)
def _add_map_gradient(
    gradient: Float32[np.ndarray, "3 tex_h tex_w"],
    upstream: Float32[np.ndarray, "ray 3"],
    place: Float32[np.ndarray, "2 ray"],
    scale: np.float32,
) -> None:
    """Adds the gradient of `_add_map` with respect to its map, ray by ray: sums repeat bit by bit."""
    for ray in range(len(upstream)):
        (top, bottom), (left, right), y, x = _taps(place, gradient, ray)
        for c in range(3):
            upper, lower = scale * (1 - y) * upstream[ray, c], scale * y * upstream[ray, c]
            gradient[c, top, left] += (1 - x) * upper
            gradient[c, top, right] += x * upper
            gradient[c, bottom, left] += (1 - x) * lower
            gradient[c, bottom, right] += x * lower


class _CompiledSky(torch.autograd.Function):
    """`_sum_of_maps` by the loops above; directions have no gradients."""

    @staticmethod
    def forward(ctx: FunctionCtx, scales: list[float], place: Float32[Tensor, "2 exit"], *maps: Tensor) -> Tensor:
        ctx.given = scales, place.numpy(), [texels.shape for texels in maps]  # pyright: ignore[reportAttributeAccessIssue]
        found = torch.zeros(place.shape[1], 3)
        for scale, texels in zip(scales, maps, strict=True):
            _add_map(found.numpy(), texels.detach().numpy(), place.numpy(), np.float32(scale))
        return found

    @staticmethod
    def backward(ctx: FunctionCtx, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        scales, place, shapes = ctx.given  # pyright: ignore[reportAttributeAccessIssue]
        above, gradients = upstream[0].contiguous().numpy(), [torch.zeros(shape) for shape in shapes]
        for scale, gradient in zip(scales, gradients, strict=True):
            _add_map_gradient(gradient.numpy(), above, place, np.float32(scale))
        return None, None, *gradients


def _sum_of_maps(
    maps: Sequence[Float32[Tensor, "3 _ _"]],
    scales: list[float],
    azimuth: Float32[Tensor, " exit"],
    polar: Float32[Tensor, " exit"],
) -> Float32[Tensor, "exit 3"]:
    """The scaled sum of bilinear look-ups in several maps at once: on a GPU, each operation is a launch."""
    device, wrapped = azimuth.device, [_wrapped(texels) for texels in maps]
    heights, widths = zip(*(texels.shape[1:] for texels in wrapped), strict=True)
    lasts = tuple(side - 1 for side in widths + heights)
    firsts = itertools.accumulate((height * width for height, width in zip(heights[:-1], widths)), initial=0)
    first, stride = (constant_on(tuple(values), torch.int32, device) for values in (firsts, widths))
    last = constant_on(lasts, torch.int32, device).view(2, 1, -1)
    half = constant_on(
        tuple((side - 2) / 2 for side in widths) + tuple(side / 2 for side in heights), torch.float32, device
    )
    half = half.view(2, 1, -1)
    middle = last / 2
    texels, weights = taps_around(middle + half * torch.stack([azimuth, polar])[..., None], first, last, stride)
    table = torch.cat([texels.flatten(1) for texels in wrapped], dim=1).T.contiguous()
    repeated = tuple(scale for scale in scales for _ in range(4))
    return sum_texels(table, texels, weights * constant_on(repeated, torch.float32, device))
