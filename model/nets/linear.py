"""Linear layers over many pixels on a CPU, by oneDNN: torch takes MKL for float32, which is slower.

Measured on an AMD processor with AVX-512 (65,536 pixels, 96 to 88 channels): the products of the forward pass and of
the input's gradient take less than half the time. For bfloat16 torch takes oneDNN by itself.
"""

import platform

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx
from torch.nn import functional

HAS_ONEDNN = torch.backends.mkldnn.is_available() and platform.machine() == "x86_64"
"""The operation below is registered where torch was built with oneDNN; on other processors nobody has measured it."""


def linear_leaky(
    x: Float[Tensor, "ray c_in"], weight: Float[Tensor, "c_out c_in"], bias: Float[Tensor, " c_out"], slope: float
) -> Float[Tensor, "ray c_out"]:
    """LeakyReLU of a linear layer, in one pass where oneDNN is there; has no gradient. Slope 1 is no activation."""
    if HAS_ONEDNN and x.device.type == "cpu":
        return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "leaky_relu", [slope], "")
    return functional.leaky_relu_(functional.linear(x, weight, bias), slope)


class Linear(nn.Linear):
    """`torch.nn.Linear` with the same parameters and, up to rounding, the same results."""

    def forward(self, input: Float[Tensor, "*ray c_in"]) -> Float[Tensor, "*ray c_out"]:  # noqa: A002  (torch's name)
        is_plain = HAS_ONEDNN and input.device.type == "cpu" and input.dtype == torch.float32 and input.ndim == 2
        if not is_plain or torch.is_autocast_enabled("cpu"):
            return super().forward(input)
        return _OneDnnLinear.apply(input, self.weight, self.bias)


class _OneDnnLinear(torch.autograd.Function):
    """A linear layer whose two large matrix products run in oneDNN."""

    @staticmethod
    def forward(ctx: FunctionCtx, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return _product(x, weight, bias)

    @staticmethod
    def backward(ctx: FunctionCtx, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        x, weight = ctx.saved_tensors  # pyright: ignore[reportAttributeAccessIssue]
        needs_x, needs_weight, needs_bias = ctx.needs_input_grad  # pyright: ignore[reportAttributeAccessIssue]
        return (
            _product(upstream[0], weight.T, None) if needs_x else None,
            upstream[0].T @ x if needs_weight else None,  # Few rows and columns: MKL is as fast, and copies nothing.
            upstream[0].sum(dim=0) if needs_bias else None,
        )


def _product(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], "")
