"""Per-pixel networks by compiled layers: forward and backward passes of a chain of linear layers.

Each layer stores only its linear output; the next one applies batch norm and activation when it reads it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx

from model.nets.cpu.mlp_kernels import FoldedLayer, Gradients, Kernels, Made, Network, Source, find_kernels


@dataclass(frozen=True, kw_only=True, eq=False)
class ChainLayer:
    """One layer of a chain; each but the last ends with a LeakyReLU."""

    linear: nn.Linear
    norm: nn.BatchNorm1d | None = None
    """Uses the batch's moments in training; at evaluation the running ones, then without gradients."""
    slope: float | None = None
    """Slope of the LeakyReLU below zero; None for the last layer, which has none."""
    adds: bool = False
    """Add the output of the layer two before to this layer's."""


def can_fuse(x: Tensor) -> bool:
    """True where `run_chain` can be called: on a CPU, in float32, with compiled layers."""
    is_batch = x.device.type == "cpu" and x.dtype == torch.float32 and x.ndim == 2 and len(x) > 1
    return is_batch and find_kernels() is not None


def run_chain(x: Float32[Tensor, "pixel c_in"], layers: Sequence[ChainLayer]) -> Float32[Tensor, "pixel c_out"]:
    """The output of the layers for a batch; updates the running statistics of batch norms in training."""
    if not torch.is_grad_enabled() and not any(layer.norm is not None and layer.norm.training for layer in layers):
        return _kernels().draw(Network([fold(layer) for layer in layers]), x)
    parameters = [value for layer in layers for value in _parameters(layer)]
    return _Chain.apply(x, tuple(layers), *parameters)


class _Chain(torch.autograd.Function):
    @staticmethod
    def forward(ctx: FunctionCtx, x: Tensor, layers: tuple[ChainLayer, ...], *_: Tensor) -> Tensor:
        kernels, x = _kernels(), x.contiguous()
        made: list[Made] = []
        for index, layer in enumerate(layers):
            slope = 1.0 if layer.slope is None else layer.slope
            made.append(kernels.forward(_source(x, layers, made, index), layer.linear, layer.norm, slope))
            if layer.norm is not None and layer.norm.num_batches_tracked is not None:
                layer.norm.num_batches_tracked += 1
        ctx.chain = x, layers, made  # pyright: ignore[reportAttributeAccessIssue]
        return made[-1].y[:, : layers[-1].linear.out_features].contiguous()

    @staticmethod
    def backward(ctx: FunctionCtx, *upstream: Tensor) -> tuple[Any, ...]:
        kernels = _kernels()
        x, layers, made = ctx.chain  # pyright: ignore[reportAttributeAccessIssue]
        # Gradients of each layer's output after norm and activation; the last layer has neither.
        above: list[Tensor | None] = [None] * len(layers)
        above[-1] = upstream[0].contiguous()
        found: list[Gradients] = []
        for index in range(len(layers) - 1, -1, -1):
            layer, of_output = layers[index], above[index]
            assert of_output is not None
            gradients = kernels.backward(
                _source(x, layers, made, index),
                layer.linear,
                None if layer.slope is None else made[index],
                of_output,
                needs_source=index > 0 or ctx.needs_input_grad[0],  # pyright: ignore[reportAttributeAccessIssue]
                further=above[index - 1] if index else None,
            )
            found.insert(0, gradients)
            if index:
                above[index - 1] = gradients.source
                if layers[index - 1].adds:
                    above[index - 3] = gradients.source
        of_x = found[0].source
        flat: list[Tensor] = []
        for index, gradients in enumerate(found):
            behind = found[index + 1].norm if layers[index].norm is not None else None
            flat += [gradients.weight, gradients.bias, *(behind or ())]
        return (None if of_x is None else of_x[:, : x.shape[1]], None, *flat)


def fold(layer: ChainLayer) -> FoldedLayer:
    """The layer as it is at evaluation, its batch norm in weight and bias."""
    weight, bias = layer.linear.weight.detach(), layer.linear.bias.detach()
    if layer.norm is not None:
        assert layer.norm.running_mean is not None
        assert layer.norm.running_var is not None
        scale = layer.norm.weight.detach() / torch.sqrt(layer.norm.running_var + layer.norm.eps)
        weight, bias = weight * scale[:, None], (bias - layer.norm.running_mean) * scale + layer.norm.bias.detach()
    return FoldedLayer(weight=weight, bias=bias, slope=1.0 if layer.slope is None else layer.slope, adds=layer.adds)


def _kernels() -> Kernels:
    kernels = find_kernels()
    assert kernels is not None
    return kernels


def _parameters(layer: ChainLayer) -> list[Tensor]:
    norm = [] if layer.norm is None else [layer.norm.weight, layer.norm.bias]
    return [layer.linear.weight, layer.linear.bias, *norm]


def _source(x: Tensor, layers: Sequence[ChainLayer], made: Sequence[Made], index: int) -> Source:
    """The input of layer `index`."""
    if index == 0:
        return Source(x=x)
    return Source(made=made[index - 1], skip=made[index - 3] if layers[index - 1].adds else None)
