"""The convolutional blocks of DeepVoxels: two- and three-dimensional U-Nets, and the halving and doubling stages.

Everywhere: reflection padding in 2-D, replication padding in 3-D, batch norm after each convolution, no bias where
there is a norm. Source: Sitzmann et al. 2019 and the authors' module library, from its description.
"""

import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

ONEDNN_ROWS = 20_480
MOST_ZERO_CHANNELS = 8


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
        dropout: float = 0.0,
        is_linear: bool = False,
    ) -> None:
        """Args:
        is_linear: the output convolution has a bias and neither norm nor ReLU.
        """
        super().__init__()
        self.before = nn.Sequential(*conv(dims, num_inputs, width, activation=nn.LeakyReLU(0.2), dropout=dropout))
        widths = [min(width * 2**depth, max_channels) for depth in range(num_down)]
        block: nn.Module | None = None
        for depth in reversed(range(num_down)):
            inner = widths[min(depth + 1, num_down - 1)]
            block = _Skip(dims, widths[depth], inner, block, dropout=dropout)
        assert block is not None, "a U-Net has at least one stage"
        self.stages = block
        if is_linear:
            self.after = nn.Sequential(*conv(dims, 2 * width, num_outputs, activation=None, is_normed=False))
        else:
            self.after = nn.Sequential(*conv(dims, 2 * width, num_outputs, activation=nn.ReLU(), dropout=dropout))

    def forward(self, x: Tensor) -> Tensor:
        return self.after(self.stages(self.before(x)))


class _Skip(nn.Module):
    """One stage of a U-Net with all stages inside it."""

    def __init__(self, dims: int, outer: int, inner: int, inside: nn.Module | None, *, dropout: float) -> None:
        super().__init__()
        is_normed = inside is not None
        self.down = halve(dims, outer, inner, dropout=dropout, is_normed=is_normed)
        self.inside = nn.Identity() if inside is None else inside
        self.up = double(dims, inner if inside is None else 2 * inner, outer, dropout=dropout, is_normed=is_normed)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.up(self.inside(self.down(x)))], dim=1)


def halve(
    dims: int, num_inputs: int, num_outputs: int, *, middle: int = 0, dropout: float = 0.0, is_normed: bool = True
) -> nn.Sequential:
    """Half the size: a 4-wide convolution of stride 2, in 2-D after a 3-wide one to `middle` channels (0: as many)."""
    middle = middle or num_inputs
    layers: list[nn.Module] = []
    if dims == 2:
        layers += conv(2, num_inputs, middle, activation=nn.LeakyReLU(0.2), dropout=dropout, is_normed=is_normed)
    layers += conv(
        dims,
        middle if dims == 2 else num_inputs,
        num_outputs,
        kernel=4,
        stride=2,
        activation=nn.LeakyReLU(0.2),
        dropout=dropout,
        is_normed=is_normed,
    )
    return nn.Sequential(*layers)


def double(
    dims: int, num_inputs: int, num_outputs: int, *, dropout: float = 0.0, is_normed: bool = True
) -> nn.Sequential:
    """Twice the size: a transposed 4-wide convolution of stride 2, in 2-D followed by a 3-wide one."""
    transposed = (nn.ConvTranspose2d, nn.ConvTranspose3d)[dims - 2]
    layers: list[nn.Module] = [transposed(num_inputs, num_outputs, 4, stride=2, padding=1, bias=not is_normed)]
    layers += _finish(dims, num_outputs, activation=nn.ReLU(), dropout=dropout, is_normed=is_normed)
    if dims == 2:
        layers += conv(2, num_outputs, num_outputs, activation=nn.ReLU(), dropout=dropout, is_normed=is_normed)
    return nn.Sequential(*layers)


def conv(
    dims: int,
    num_inputs: int,
    num_outputs: int,
    *,
    activation: nn.Module | None,
    kernel: int = 3,
    stride: int = 1,
    dropout: float = 0.0,
    is_normed: bool = True,
) -> list[nn.Module]:
    """Padding by one pixel, convolution, norm, activation, dropout of whole channels."""
    pad = (nn.ReflectionPad2d, nn.ReplicationPad3d)[dims - 2](1)
    layer = (nn.Conv2d, Conv3d)[dims - 2](num_inputs, num_outputs, kernel, stride=stride, bias=not is_normed)
    return [pad, layer, *_finish(dims, num_outputs, activation=activation, dropout=dropout, is_normed=is_normed)]


class Conv3d(nn.Conv3d):
    """Torch's convolution, on a CPU several times as fast for few channels.

    Torch 2.13 hands a single sample to oneDNN only if it has more than 20,480 rows (channels x depth x height); below
    that an unrolled matrix product runs. Where a few channels of zeros carry the input over, they are added: the same
    sums in another order. Measured on one core, 66 x 34 x 34 voxels, forward and backward: 8 to 4 channels 160 to
    25 ms, 9 to 1 channels 110 to 20 ms.
    """

    def forward(self, input: Float32[Tensor, "b c d h w"]) -> Float32[Tensor, "b c2 d2 h2 w2"]:  # noqa: A002
        missing = ONEDNN_ROWS // (input.shape[0] * input.shape[2] * input.shape[3]) + 1 - input.shape[1]
        x, weight = input, self.weight
        if x.device.type == "cpu" and len(x) == 1 and 0 < missing <= MOST_ZERO_CHANNELS:
            x, weight = (functional.pad(t, (0,) * 7 + (missing,)) for t in (x, weight))
        return self._conv_forward(x, weight, self.bias)


def _finish(
    dims: int, channels: int, *, activation: nn.Module | None, dropout: float, is_normed: bool
) -> list[nn.Module]:
    layers: list[nn.Module] = [(nn.BatchNorm2d, nn.BatchNorm3d)[dims - 2](channels)] if is_normed else []
    if activation is not None:
        layers.append(activation)
    if dropout:
        layers.append((nn.Dropout2d, nn.Dropout3d)[dims - 2](dropout))
    return layers
