"""Tests of the network at evaluation, with its batch norms folded into weights."""

import pytest
import torch
from torch import nn
from torch.nn import functional

from model.nets.pixel_mlp import Norm, PixelMlp


def trained_net(norm: Norm) -> tuple[PixelMlp, torch.Tensor]:
    """A network whose batch norm has seen a few batches, and inputs."""
    torch.manual_seed(0)
    net = PixelMlp(40, width=32, blocks=3, norm=norm)
    with torch.no_grad():
        for module in net.modules():
            if isinstance(module, nn.BatchNorm1d):
                module.weight.uniform_(0.5, 1.5)
                module.bias.normal_(std=0.3)
        for _ in range(20):
            net(2 * torch.randn(500, 40) + 0.5)
    return net.eval(), 2 * torch.randn(1000, 40) + 0.5


@pytest.mark.parametrize("norm", ["batch", "none"])
def test_layers_with_folded_norms_compute_what_the_network_does_at_evaluation(norm: Norm) -> None:
    net, x = trained_net(norm)

    def unit(x: torch.Tensor, layer: int) -> torch.Tensor:
        return functional.leaky_relu(functional.linear(x, *layers[layer]), 0.2)

    with torch.inference_mode():
        layers = net.folded()
        hidden = unit(x, 0)
        for first in range(1, len(layers) - 1, 3):
            hidden = unit(hidden + unit(unit(hidden, first), first + 1), first + 2)
        found, expected = functional.linear(hidden, *layers[-1]), net(x)
    assert (found - expected).abs().max() / expected.abs().max() < 1e-5
