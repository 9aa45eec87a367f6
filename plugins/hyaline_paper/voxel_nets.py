"""The networks of DeepVoxels: from a picture to features, into the grid, and from rays to a picture.

Everywhere: reflection padding in 2-D, replication padding in 3-D, batch norm after each convolution, no bias where
there is a norm. Source: Sitzmann et al. 2019 and the code they released, from its description.
"""

import math

import torch
from jaxtyping import Float32
from torch import Tensor, nn


class Unet(nn.Module):
    """A U-Net of `num_down` halvings, in 2-D with two convolutions a stage, in 3-D with one.

    Channels double with each halving up to `max_channels`; the innermost stage has no norm, since its map may be one
    pixel. Each stage hands on its input beside its output.
    """

    def __init__(
        self,
        dims: int,
        num_inputs: int,
        num_outputs: int,
        *,
        width: int,
        num_down: int,
        max_channels: int,
    ) -> None:
        super().__init__()
        self.before = nn.Sequential(*conv(dims, num_inputs, width, activation=nn.LeakyReLU(0.2)))
        widths = [min(width * 2**depth, max_channels) for depth in range(num_down)]
        block: nn.Module | None = None
        for depth in reversed(range(num_down)):
            inner = widths[min(depth + 1, num_down - 1)]
            block = _Skip(dims, widths[depth], inner, block)
        assert block is not None, "a U-Net has at least one stage"
        self.stages = block
        self.after = nn.Sequential(*conv(dims, 2 * width, num_outputs, activation=nn.ReLU()))

    def forward(self, x: Tensor) -> Tensor:
        return self.after(self.stages(self.before(x)))


class _Skip(nn.Module):
    """One stage of a U-Net with all stages inside it."""

    def __init__(self, dims: int, outer: int, inner: int, inside: nn.Module | None) -> None:
        super().__init__()
        is_normed = inside is not None
        self.down = halve(dims, outer, inner, is_normed=is_normed)
        self.inside = nn.Identity() if inside is None else inside
        self.up = double(dims, inner if inside is None else 2 * inner, outer, is_normed=is_normed)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.up(self.inside(self.down(x)))], dim=1)


def halve(dims: int, num_inputs: int, num_outputs: int, *, middle: int = 0, is_normed: bool = True) -> nn.Sequential:
    """Half the size: a 4-wide convolution of stride 2, in 2-D after a 3-wide one to `middle` channels (0: as many)."""
    middle = middle or num_inputs
    layers: list[nn.Module] = []
    if dims == 2:
        layers += conv(2, num_inputs, middle, activation=nn.LeakyReLU(0.2), is_normed=is_normed)
    layers += conv(
        dims,
        middle if dims == 2 else num_inputs,
        num_outputs,
        kernel=4,
        stride=2,
        activation=nn.LeakyReLU(0.2),
        is_normed=is_normed,
    )
    return nn.Sequential(*layers)


def double(dims: int, num_inputs: int, num_outputs: int, *, is_normed: bool = True) -> nn.Sequential:
    """Twice the size: a transposed 4-wide convolution of stride 2, in 2-D followed by a 3-wide one."""
    transposed = (nn.ConvTranspose2d, nn.ConvTranspose3d)[dims - 2]
    layers: list[nn.Module] = [transposed(num_inputs, num_outputs, 4, stride=2, padding=1, bias=not is_normed)]
    layers += _finish(dims, num_outputs, activation=nn.ReLU(), is_normed=is_normed)
    if dims == 2:
        layers += conv(2, num_outputs, num_outputs, activation=nn.ReLU(), is_normed=is_normed)
    return nn.Sequential(*layers)


def conv(
    dims: int,
    num_inputs: int,
    num_outputs: int,
    *,
    activation: nn.Module | None,
    kernel: int = 3,
    stride: int = 1,
    is_normed: bool = True,
) -> list[nn.Module]:
    """Padding by one pixel, convolution, norm, activation."""
    pad = (nn.ReflectionPad2d, nn.ReplicationPad3d)[dims - 2](1)
    layer = (nn.Conv2d, nn.Conv3d)[dims - 2](num_inputs, num_outputs, kernel, stride=stride, bias=not is_normed)
    return [pad, layer, *_finish(dims, num_outputs, activation=activation, is_normed=is_normed)]


def _finish(dims: int, channels: int, *, activation: nn.Module | None, is_normed: bool) -> list[nn.Module]:
    layers: list[nn.Module] = [(nn.BatchNorm2d, nn.BatchNorm3d)[dims - 2](channels)] if is_normed else []
    if activation is not None:
        layers.append(activation)
    return layers


OCCLUSION_CHANNELS = 4

Volume = Float32[Tensor, "1 c z y x"]


def feature_extractor(*, width: int, num_outputs: int, num_halvings: int, plane_size: int) -> nn.Sequential:
    """Picture to feature map: halvings that double the channels, then a U-Net down to one pixel."""
    channels = [width * 2**stage for stage in range(num_halvings)]
    stages = [
        halve(2, channels[stage - 1] if stage else 3, after, middle=0 if stage else after)
        for stage, after in enumerate(channels)
    ]
    return nn.Sequential(
        *stages,
        Unet(
            2,
            channels[-1],
            num_outputs,
            width=channels[-1],
            num_down=int(math.log2(plane_size)),
            max_channels=8 * width,
        ),
    )


def rendering_network(*, width: int, num_inputs: int, num_doublings: int, plane_size: int) -> nn.Sequential:
    """Features of rays to colours in [-1, 1]: a U-Net down to one pixel, then doublings."""
    unet = Unet(
        2,
        num_inputs,
        4 * width,
        width=width * 2**num_doublings,
        num_down=int(math.log2(plane_size)),
        max_channels=8 * width,
    )
    return nn.Sequential(
        unet,
        *(double(2, 4 * width if stage == 0 else width, width) for stage in range(num_doublings)),
        *conv(2, width, width // 2, activation=nn.ReLU()),
        *conv(2, width // 2, 3, activation=nn.Tanh(), is_normed=False),
    )


class Integration(nn.Module):
    """A gated recurrent unit whose state is the grid; a gate is one number for each voxel.

    The candidate is a tanh, as in other gated units, where the authors have a ReLU and dropout: with ReLU, later norms
    hide the grid's scale from the loss, and at a rate of 0.002 it overflowed after 80 steps.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        # Inputs of the reset gate, the update gate and the candidate: from the new observation, then the old state.
        self.new = _conv3(features + 3, 2 + features)
        self.old_gates = _conv3(features + 3, 2, has_bias=False)
        self.old_candidate = _conv3(features + 3, features, has_bias=False)

    def forward(self, new: Volume, old: Volume, coordinates: Float32[Tensor, "1 3 z y x"]) -> Volume:
        """The state after an observation; both gates and the candidate also see the voxels' coordinates."""
        old_placed = torch.cat([old, coordinates], dim=1)
        from_new = self.new(torch.cat([new, coordinates], dim=1))
        reset, update = torch.sigmoid(from_new[:, :2] + self.old_gates(old_placed)).split(1, dim=1)
        from_old = self.old_candidate(reset * old_placed)
        candidate = torch.tanh(from_new[:, 2:] + from_old)
        return (1 - update) * old + update * candidate


def _conv3(num_inputs: int, num_outputs: int, *, has_bias: bool = True) -> nn.Sequential:
    return nn.Sequential(nn.ReplicationPad3d(1), nn.Conv3d(num_inputs, num_outputs, 3, bias=has_bias))


class Occlusion(nn.Module):
    """Visibility of each plane of a frustum along each ray: weights that sum to 1 over depth."""

    def __init__(self, features: int, *, num_planes: int, plane_size: int) -> None:
        super().__init__()
        channels = OCCLUSION_CHANNELS
        self.prepare = nn.Sequential(*conv(3, features + 1, channels, activation=nn.ReLU()))
        num_down = int(math.log2(min(num_planes, plane_size)))
        self.unet = Unet(3, channels, channels, width=channels, num_down=num_down, max_channels=4 * channels)
        self.weigh = _conv3(2 * channels + 1, 1)
        depth = torch.arange(-(num_planes // 2), num_planes // 2) / num_planes
        self.register_buffer("depth", depth[:, None, None].expand(1, 1, -1, plane_size, plane_size), persistent=False)

    def forward(self, frustum: Float32[Tensor, "1 c d p q"]) -> Float32[Tensor, "1 1 d p q"]:
        depth = self.get_buffer("depth")
        prepared = self.prepare(torch.cat([depth, frustum], dim=1))
        weights = self.weigh(torch.cat([prepared, self.unet(prepared), depth], dim=1))
        return torch.softmax(weights, dim=2)


def collapse(
    frustum: Float32[Tensor, "1 c d p q"], visibility: Float32[Tensor, "1 1 d p q"]
) -> Float32[Tensor, "1 c p q"]:
    """Features of each ray: the *mean* over depth of visible features, as in the authors' code; a sum over d planes."""
    return (visibility * frustum).mean(dim=2)
