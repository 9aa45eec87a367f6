"""The paper's renderer network: a residual MLP that turns one pixel's stacked layers into its colour."""

import functools
from typing import cast

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_linear_bn_weights

from model.settings import Norm, check_width

LEAKY_SLOPE = 0.2


class LinearUnit(nn.Module):
    """Linear layer, batch norm, LeakyReLU."""

    def __init__(self, num_inputs: int, num_outputs: int, norm: Norm) -> None:
        super().__init__()
        self.linear = nn.Linear(num_inputs, num_outputs)
        self.norm = nn.BatchNorm1d(num_outputs) if norm == "batch" else nn.Identity()
        self.activation = nn.LeakyReLU(LEAKY_SLOPE, inplace=True)

    def forward(self, x: Float[Tensor, "ray c_in"]) -> Float[Tensor, "ray c_out"]:
        return self.activation(self.norm(self.linear(x)))

    def folded(self) -> tuple[Tensor, Tensor]:
        """Weight (c_out, c_in) and bias (c_out) of the linear layer with the batch norm, as it is at evaluation."""
        norm = self.norm
        if not isinstance(norm, nn.BatchNorm1d):
            return self.linear.weight, self.linear.bias
        assert norm.running_mean is not None
        assert norm.running_var is not None
        return fuse_linear_bn_weights(
            self.linear.weight, self.linear.bias, norm.running_mean, norm.running_var, norm.eps, norm.weight, norm.bias
        )


class ResidualBlock(nn.Module):
    """Two units whose input is added to their output, then a unit that halves the channels."""

    def __init__(self, width: int, norm: Norm) -> None:
        super().__init__()
        self.first = LinearUnit(width, width, norm)
        self.second = LinearUnit(width, width, norm)
        self.halve = LinearUnit(width, width // 2, norm)

    def forward(self, x: Float[Tensor, "ray c"]) -> Float[Tensor, "ray c_half"]:
        return self.halve(x + self.second(self.first(x)))


class PixelMlp(nn.Module):
    """Colours of pixels from their stacked layers.

    Source: paper section 4.3. Its "256 hidden units" and its "34k parameters" exclude each other; `width` decides:
    `width_for_34k` or 256. At evaluation batch norm uses its running statistics (the authors' test script left their
    dropout on). The output has no activation: clip it to [0, 1] for display.
    """

    def __init__(self, num_inputs: int, *, width: int, blocks: int, norm: Norm) -> None:
        super().__init__()
        check_width(width, blocks)
        self.first = LinearUnit(num_inputs, width, norm)
        self.blocks = nn.Sequential(*(ResidualBlock(width >> index, norm) for index in range(blocks)))
        self.last = nn.Linear(width >> blocks, 3)
        # Start at mid-grey: from zero, Adam would move only 0.001 per step towards the mean colour.
        nn.init.constant_(self.last.bias, 0.5)

    def forward(self, x: Float32[Tensor, "ray c"]) -> Float32[Tensor, "ray 3"]:
        """sRGB colours, about [0, 1], of the inputs of all layers, nearest first."""
        return self.last(self.blocks(self.first(x)))

    def residual_blocks(self) -> list[ResidualBlock]:
        """The blocks in their order."""
        return cast(list[ResidualBlock], list(self.blocks))

    def folded(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and biases of all layers at evaluation, in their order."""
        units = [self.first]
        for block in self.residual_blocks():
            units += [block.first, block.second, block.halve]
        return [*(unit.folded() for unit in units), (self.last.weight, self.last.bias)]


@functools.cache
def width_for_34k(num_inputs: int, blocks: int) -> int:
    """The hidden width that makes the network closest to the 34,000 parameters of paper section 4.3."""
    candidates = range(1 << blocks, 385, 1 << blocks)
    return min(candidates, key=lambda width: abs(count_parameters(num_inputs, width, blocks) - 34_000))


def count_parameters(num_inputs: int, width: int, blocks: int, norm: Norm = "batch") -> int:
    """Learned numbers of a `PixelMlp`, without building it on a real device."""
    with torch.device("meta"):
        net = PixelMlp(num_inputs, width=width, blocks=blocks, norm=norm)
    return sum(parameter.numel() for parameter in net.parameters())
