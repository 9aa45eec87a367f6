"""Owns the training of per-pixel networks by compiled layers: forward and backward passes of a chain of linear layers.

Between two layers nothing is written but what the first one made: its batch norm and activation are done by whoever
reads it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx

from model.mlp_kernels import FoldedLayer, Kernels, Made, Moments, Network, Source, find_kernels, pad


@dataclass(frozen=True, kw_only=True, eq=False)
class ChainLayer:
    """One layer of a chain; each but the last ends with a LeakyReLU."""

    linear: nn.Linear
    norm: nn.BatchNorm1d | None = None
    """In training: with the moments of the batch."""
    slope: float | None = None
    """Of the LeakyReLU below zero; None for the last layer, which has none."""
    adds: bool = False
    """To what this layer makes, the output of the layer two before is added."""


def can_fuse(x: Tensor) -> bool:
    """True where `run_chain` can be called: on a CPU, in float32, with compiled layers."""
    is_batch = x.device.type == "cpu" and x.dtype == torch.float32 and x.ndim == 2 and len(x) > 1
    return is_batch and find_kernels() is not None


def run_chain(x: Float32[Tensor, "pixel c_in"], layers: Sequence[ChainLayer]) -> Float32[Tensor, "pixel c_out"]:
    """What the layers make of a batch; running statistics of batch norms are brought up to date."""
    if not torch.is_grad_enabled() and not any(layer.norm for layer in layers):
        return _kernels().draw(Network([_folded(layer) for layer in layers]), x)
    parameters = [value for layer in layers for value in _parameters(layer)]
    return _Chain.apply(x, tuple(layers), *parameters)


class _Chain(torch.autograd.Function):
    @staticmethod
    def forward(ctx: FunctionCtx, x: Tensor, layers: tuple[ChainLayer, ...], *_: Tensor) -> Tensor:
        kernels, x = _kernels(), x.contiguous()
        made: list[Made] = []
        for index, layer in enumerate(layers):
            weight, bias = layer.linear.weight.detach(), layer.linear.bias.detach()
            source = _source(x, layers, made, index)
            y, moments = kernels.forward(source, weight, bias, measures=layer.norm is not None)
            made.append(_made(layer, y, moments))
        ctx.chain = x, layers, made  # pyright: ignore[reportAttributeAccessIssue]
        return made[-1].y[:, : layers[-1].linear.out_features].contiguous()

    @staticmethod
    def backward(ctx: FunctionCtx, *upstream: Tensor) -> tuple[Any, ...]:
        kernels = _kernels()
        x, layers, made = ctx.chain  # pyright: ignore[reportAttributeAccessIssue]
        # Of what each layer made, after norm and activation; of the last one, which has neither, as it is.
        gradients: list[Tensor | None] = [None] * len(layers)
        gradients[-1] = upstream[0].contiguous()
        of_parameters: list[tuple[Tensor, ...]] = [()] * len(layers)
        of_x = None
        for index in range(len(layers) - 1, -1, -1):
            layer, above = layers[index], gradients[index]
            assert above is not None
            source = _source(x, layers, made, index)
            of_source, of_weight, of_bias = kernels.backward(
                source, layer.linear.weight.detach(), None if layer.slope is None else made[index], above,
                needs_input=index > 0 or ctx.needs_input_grad[0],  # pyright: ignore[reportAttributeAccessIssue]
                further=gradients[index - 1] if index else None,
            )  # fmt: skip
            if index:
                gradients[index - 1] = of_source
                if layers[index - 1].adds:
                    gradients[index - 3] = of_source
            else:
                of_x = of_source
            of_parameters[index] = (of_weight, of_bias, *_norm_gradients(layer, made[index]))
        flat = [gradient for of_layer in of_parameters for gradient in of_layer]
        return (None if of_x is None else of_x[:, : x.shape[1]], None, *flat)


def _folded(layer: ChainLayer) -> FoldedLayer:
    slope = 1.0 if layer.slope is None else layer.slope
    return FoldedLayer(weight=layer.linear.weight, bias=layer.linear.bias, slope=slope, adds=layer.adds)


def _kernels() -> Kernels:
    kernels = find_kernels()
    assert kernels is not None
    return kernels


def _parameters(layer: ChainLayer) -> list[Tensor]:
    norm = [] if layer.norm is None else [layer.norm.weight, layer.norm.bias]
    return [layer.linear.weight, layer.linear.bias, *norm]


def _source(x: Tensor, layers: Sequence[ChainLayer], made: Sequence[Made], index: int) -> Source:
    """What layer `index` reads."""
    if index == 0:
        return Source(x=x)
    return Source(made=made[index - 1], skip=made[index - 3] if layers[index - 1].adds else None)


def _made(layer: ChainLayer, y: Tensor, moments: Moments | None) -> Made:
    """A layer's result with its norm as scale and shift; the norm's running statistics move on."""
    slope = 1.0 if layer.slope is None else layer.slope
    outputs = layer.linear.out_features
    if layer.norm is None:
        return Made(y=y, scale=pad(np.ones(outputs)), shift=pad(np.zeros(outputs)), slope=slope)
    assert moments is not None
    norm = layer.norm
    inverse_deviation = 1 / np.sqrt(moments.variance + norm.eps)
    scale = norm.weight.detach().numpy() * inverse_deviation
    _move_on(norm, moments, len(y))
    return Made(
        y=y, scale=pad(scale), shift=pad(norm.bias.detach().numpy() - moments.mean * scale), slope=slope,
        mean=pad(moments.mean), inverse_deviation=pad(inverse_deviation),
    )  # fmt: skip


def _move_on(norm: nn.BatchNorm1d, moments: Moments, count: int) -> None:
    """What torch does to the running statistics in training."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    assert norm.num_batches_tracked is not None
    assert norm.momentum is not None
    for running, value in (
        (norm.running_mean, moments.mean),
        (norm.running_var, moments.variance * count / (count - 1)),
    ):
        values = running.numpy()
        values += norm.momentum * (value - values)
    norm.num_batches_tracked += 1


def _norm_gradients(layer: ChainLayer, made: Made) -> tuple[Tensor, ...]:
    """Of the norm's weight and bias."""
    if layer.norm is None:
        return ()
    assert made.sums is not None
    return tuple(torch.from_numpy(values.astype(np.float32)) for values in made.sums[::-1])
