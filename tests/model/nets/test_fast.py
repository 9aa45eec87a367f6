"""Tests of the network's two forms: what compiled layers draw is what torch's draw, and bf16 is torch's alone."""

import pytest
import torch
from torch import nn

from model.nets import pixel_mlp
from model.nets.cpu.mlp_kernels import find_kernels
from model.nets.pixel_mlp import Norm, PixelMlp, Precision


def trained_net(norm: Norm, precision: Precision = "fp32") -> tuple[PixelMlp, torch.Tensor]:
    """A network whose batch norm has seen a few batches, and inputs."""
    torch.manual_seed(0)
    net = PixelMlp(40, width=32, blocks=3, norm=norm, precision=precision)
    with torch.no_grad():
        for module in net.modules():
            if isinstance(module, nn.BatchNorm1d):
                module.weight.uniform_(0.5, 1.5)
                module.bias.normal_(std=0.3)
        for _ in range(20):
            net(2 * torch.randn(500, 40) + 0.5)
    return net.eval(), 2 * torch.randn(1000, 40) + 0.5


@pytest.mark.skipif(find_kernels() is None, reason="there is no compiler")
@pytest.mark.parametrize("norm", ["batch", "none"])
def test_compiled_layers_draw_what_torchs_do_and_change_nothing(norm: Norm, monkeypatch: pytest.MonkeyPatch) -> None:
    net, x = trained_net(norm)
    before, state = x.clone(), {name: value.clone() for name, value in net.state_dict().items()}
    with torch.inference_mode():
        found = net(x)
    monkeypatch.setattr(pixel_mlp, "can_fuse", lambda _: False)
    with torch.inference_mode():
        expected = net(x)
    assert not torch.equal(found, expected), "two ways, two roundings"
    assert (found - expected).abs().max() / expected.abs().max() < 1e-5
    assert torch.equal(x, before)
    assert all(torch.equal(value, state[name]) for name, value in net.state_dict().items())


def test_at_evaluation_gradients_flow_past_the_norms() -> None:
    net, x = trained_net("batch")
    x.requires_grad_()
    net(x).sum().backward()
    assert x.grad is not None and x.grad.abs().min(dim=1).values.ne(0).any()
    moved = x.detach() + 1e-3 * x.grad / x.grad.norm()
    with torch.inference_mode():
        gained = net(moved).double().sum() - net(x).double().sum()
    assert gained.item() == pytest.approx(1e-3 * x.grad.norm().item(), rel=0.05)


@torch.inference_mode()
def test_bf16_agrees_to_a_hundredth_and_repeats() -> None:
    exact, x = trained_net("batch")
    net, _ = trained_net("batch", "bf16")
    net.load_state_dict(exact.state_dict())
    expected = exact(x)
    found = net(x)
    assert found.dtype == torch.float32
    assert 0 < (found - expected).abs().max() / expected.abs().max() < 1e-2
    assert torch.equal(found, net(x))


def test_a_network_in_bf16_learns_float32_parameters() -> None:
    net, x = trained_net("batch", "bf16")
    net.train()(x).square().mean().backward()
    assert all(item.grad is not None and item.grad.dtype == torch.float32 for item in net.parameters())
