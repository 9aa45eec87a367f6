"""The networks that DeepVoxels is made of: from a picture to features, into the grid, and from rays to a picture.

Source: Sitzmann et al. 2019 and the code they released, from its description.
"""

import math

import torch
from jaxtyping import Float32
from torch import Tensor, nn

from model.nets.voxel_blocks import Conv3d, Unet, conv, double, halve

OCCLUSION_CHANNELS = 4

Volume = Float32[Tensor, "1 c z y x"]


def feature_extractor(*, width: int, num_outputs: int, num_halvings: int, plane_size: int) -> nn.Sequential:
    """Picture to feature map: halvings that double the channels, then a U-Net down to one pixel.

    Without a halving, which the authors' code cannot build, the U-Net sees the picture itself.
    """
    channels = [width * 2**stage for stage in range(num_halvings)]
    stages = [
        halve(2, channels[stage - 1] if stage else 3, after, middle=0 if stage else after)
        for stage, after in enumerate(channels)
    ]
    return nn.Sequential(
        *stages,
        Unet(
            2,
            channels[-1] if channels else 3,
            num_outputs,
            width=channels[-1] if channels else width,
            num_down=int(math.log2(plane_size)),
            max_channels=8 * width,
        ),
    )


def rendering_network(
    *, width: int, num_inputs: int, num_doublings: int, plane_size: int, dropout: float
) -> nn.Sequential:
    """Features of rays to colours in [-1, 1]: a U-Net down to one pixel, then doublings."""
    unet = Unet(
        2,
        num_inputs,
        4 * width if num_doublings else 3,
        width=width * 2**num_doublings,
        num_down=int(math.log2(plane_size)),
        max_channels=8 * width,
        dropout=dropout,
        is_linear=num_doublings == 0,
    )
    if not num_doublings:
        return nn.Sequential(unet, nn.Tanh())
    return nn.Sequential(
        unet,
        *(double(2, 4 * width if stage == 0 else width, width, dropout=dropout) for stage in range(num_doublings)),
        *conv(2, width, width // 2, activation=nn.ReLU()),
        *conv(2, width // 2, 3, activation=nn.Tanh(), is_normed=False),
    )


class Integration(nn.Module):
    """A gated recurrent unit whose state is the grid; a gate is one number for each voxel."""

    def __init__(self, features: int, *, dropout: float, bounded: bool) -> None:
        super().__init__()
        # What the new observation says to the reset gate, the update gate and the candidate; what the old state says.
        self.new = _conv3(features + 3, 2 + features)
        self.old_gates = _conv3(features + 3, 2, has_bias=False)
        self.old_candidate = _conv3(features + 3, features, has_bias=False)
        self.drop = nn.Dropout3d(dropout)
        self.activation = nn.Tanh() if bounded else nn.ReLU()

    def forward(self, new: Volume, old: Volume, coordinates: Float32[Tensor, "1 3 z y x"]) -> Volume:
        """The state after an observation; both gates and the candidate also see the voxels' coordinates."""
        old_placed = torch.cat([old, coordinates], dim=1)
        from_new = self.new(torch.cat([new, coordinates], dim=1))
        reset, update = torch.sigmoid(from_new[:, :2] + self.old_gates(old_placed)).split(1, dim=1)
        from_old = self.old_candidate(reset * old_placed)
        candidate = self.activation(self.drop(from_new[:, 2:]) + self.drop(from_old))
        return (1 - update) * old + update * candidate


def _conv3(num_inputs: int, num_outputs: int, *, has_bias: bool = True) -> nn.Sequential:
    return nn.Sequential(nn.ReplicationPad3d(1), Conv3d(num_inputs, num_outputs, 3, bias=has_bias))


class Occlusion(nn.Module):
    """How visible each plane of a frustum is along each ray: weights that sum to 1 over depth."""

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


class Critic(nn.Module):
    """Tells patches of 70 pixels of true pictures from drawn ones: a logit each."""

    def __init__(self, width: int = 28) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.ReflectionPad2d(1), nn.Conv2d(3, width, 4, stride=2), nn.LeakyReLU(0.2)]
        for stage, stride in enumerate((2, 2, 1)):
            before, after = width * 2**stage, width * 2 ** (stage + 1)
            layers += [nn.ReflectionPad2d(1), nn.Conv2d(before, after, 4, stride=stride)]
            layers += [nn.BatchNorm2d(after), nn.Dropout2d(0.5), nn.LeakyReLU(0.2)]
        self.layers = nn.Sequential(*layers, nn.ReflectionPad2d(1), nn.Conv2d(8 * width, 1, 4))

    def forward(self, image: Float32[Tensor, "1 3 h w"]) -> Float32[Tensor, "1 1 patch_h patch_w"]:
        """Above 0 for true. Colours as the renderer has them before they are shifted, in [-0.5, 0.5]."""
        return self.layers(image)
