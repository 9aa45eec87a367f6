"""The paper's renderer network: a residual MLP that turns one pixel's stacked layers into its colour."""

from typing import cast

import torch
from jaxtyping import Float32
from torch import Tensor, nn

from model.nets.cpu.fused_mlp import ChainLayer, can_fuse, run_chain
from model.nets.cpu.mlp_kernels import FoldedLayer, Network, find_kernels
from model.nets.linear import Linear, linear_leaky
from model.settings.network_parts import Norm, Precision, check_width

LEAKY_SLOPE = 0.2


class LinearUnit(nn.Module):
    """Linear layer, batch norm, LeakyReLU. A `Linear` over (ray, c) is a 1x1 convolution, and faster on a CPU."""

    def __init__(self, num_inputs: int, num_outputs: int, norm: Norm) -> None:
        super().__init__()
        self.linear = Linear(num_inputs, num_outputs)
        self.norm = nn.BatchNorm1d(num_outputs) if norm == "batch" else nn.Identity()
        self.activation = nn.LeakyReLU(LEAKY_SLOPE, inplace=True)

    def forward(self, x: Float32[Tensor, "ray c_in"]) -> Float32[Tensor, "ray c_out"]:
        return self.activation(self.norm(self.linear(x)))

    def folded(self) -> tuple[Float32[Tensor, "c_out c_in"], Float32[Tensor, " c_out"]]:
        """Weight and bias of the layer with its batch norm in them, as they are at evaluation."""
        weight, bias = self.linear.weight.detach(), self.linear.bias.detach()
        if isinstance(self.norm, nn.BatchNorm1d):
            assert self.norm.running_mean is not None
            assert self.norm.running_var is not None
            scale = self.norm.weight.detach() / torch.sqrt(self.norm.running_var + self.norm.eps)
            weight, bias = weight * scale[:, None], (bias - self.norm.running_mean) * scale + self.norm.bias.detach()
        return weight, bias


class ResidualBlock(nn.Module):
    """Two units whose input is added to their output, then a unit that halves the channels."""

    def __init__(self, width: int, norm: Norm) -> None:
        super().__init__()
        self.first = LinearUnit(width, width, norm)
        self.second = LinearUnit(width, width, norm)
        self.halve = LinearUnit(width, width // 2, norm)

    def forward(self, x: Float32[Tensor, "ray c"]) -> Float32[Tensor, "ray c_half"]:
        return self.halve(x + self.second(self.first(x)))


class PixelMlp(nn.Module):
    """Colours of pixels from their stacked layers.

    Source: paper section 4.3. Its "256 hidden units" and its "34k parameters" exclude each other; `width` decides:
    `width_for_34k` or 256. At evaluation batch norm uses its running statistics (the authors' test script left their
    dropout on). The output has no activation: clip it to [0, 1] for display.
    """

    def __init__(self, num_inputs: int, *, width: int, blocks: int, norm: Norm, precision: Precision = "fp32") -> None:
        super().__init__()
        check_width(width, blocks)
        self.precision: Precision = precision
        self.first = LinearUnit(num_inputs, width, norm)
        self.blocks = nn.Sequential(*(ResidualBlock(width >> index, norm) for index in range(blocks)))
        self.last = Linear(width >> blocks, 3)
        # Mid-grey to start with: from zero, Adam walks only 0.001 a step towards the mean colour.
        nn.init.constant_(self.last.bias, 0.5)

    def forward(self, x: Float32[Tensor, "ray c"]) -> Float32[Tensor, "ray 3"]:
        """sRGB colours, about [0, 1], of the inputs of all layers, nearest first."""
        if self.precision == "fp32" and can_fuse(x) and (chain := self._chain()) is not None:
            return run_chain(x, chain)
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.precision == "bf16"):
            hidden = self.blocks(self.first(x))
        return self.last(hidden.float())  # In bf16 a colour would have as few steps as an 8-bit picture.

    def units(self) -> list[tuple[LinearUnit, bool]]:
        """All layers but the last, each with whether the output of the one two before is added to its own."""
        units = [(self.first, False)]
        for block in self.residual_blocks():
            units += [(block.first, False), (block.second, True), (block.halve, False)]
        return units

    def residual_blocks(self) -> list[ResidualBlock]:
        """The blocks in their order."""
        return cast(list[ResidualBlock], list(self.blocks))

    def _chain(self) -> list[ChainLayer] | None:
        """The layers in their order; None where compiled ones compute something else."""
        layers: list[ChainLayer] = []
        for unit, adds in self.units():
            norm = unit.norm if isinstance(unit.norm, nn.BatchNorm1d) else None
            # At evaluation, and among several processes, a batch's own moments are not what it is normalised by.
            if norm is not None and (type(norm) is not nn.BatchNorm1d or not self.training):
                return None
            layers.append(ChainLayer(linear=unit.linear, norm=norm, slope=LEAKY_SLOPE, adds=adds))
        return [*layers, ChainLayer(linear=self.last)]

    def folded(self) -> "FoldedMlp":
        """What this network computes at evaluation, several times faster; has no gradient, learns nothing more."""
        return FoldedMlp(self)


class FoldedMlp:
    """A `PixelMlp` at evaluation, with batch norm folded into the linear layers and the activations done with them."""

    def __init__(self, net: PixelMlp) -> None:
        is_half = net.precision == "bf16"
        self.layers = [
            FoldedLayer(weight=weight, bias=bias, slope=LEAKY_SLOPE, adds=adds, is_half=is_half)
            for (weight, bias), adds in ((unit.folded(), adds) for unit, adds in net.units())
        ]
        # In bf16 a colour would have as few steps as an 8-bit picture.
        self.layers.append(FoldedLayer(weight=net.last.weight.detach(), bias=net.last.bias.detach()))
        kernels = find_kernels() if net.last.weight.device.type == "cpu" else None
        self.kernels = None if kernels is None or (is_half and not kernels.can_multiply_bf16) else kernels
        self.network = None if self.kernels is None else Network(self.layers)

    def __call__(self, x: Float32[Tensor, "ray c"]) -> Float32[Tensor, "ray 3"]:
        if self.kernels is not None and self.network is not None:
            return self.kernels.draw(self.network, x)
        made = [x]
        for layer in self.layers:
            dtype = torch.bfloat16 if layer.is_half else torch.float32
            out = linear_leaky(made[-1].to(dtype), layer.weight.to(dtype), layer.bias.to(dtype), layer.slope)
            made = [*made[-2:], out.add_(made[-2]) if layer.adds else out]
        return made[-1]


def width_for_34k(num_inputs: int, blocks: int) -> int:
    """The hidden width that makes the network closest to the 34,000 parameters of paper section 4.3."""
    candidates = range(1 << blocks, 385, 1 << blocks)
    return min(candidates, key=lambda width: abs(count_parameters(num_inputs, width, blocks) - 34_000))


def count_parameters(num_inputs: int, width: int, blocks: int, norm: Norm = "batch") -> int:
    """Learned numbers of a `PixelMlp`, without building it on a real device."""
    with torch.device("meta"):
        net = PixelMlp(num_inputs, width=width, blocks=blocks, norm=norm)
    return sum(parameter.numel() for parameter in net.parameters())
