"""Tests of the network's fast forms: equal to the plain ones, also where gradients flow."""

import pytest
import torch
from torch import nn

from model.batches.rays import Pixels
from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer
from model.nets import linear, pixel_mlp
from model.nets.linear import Linear
from model.nets.pixel_mlp import Norm, PixelMlp, Precision
from model.run.predict import predict_colors


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


@pytest.mark.parametrize("norm", ["batch", "none"])
@pytest.mark.parametrize("has_onednn", [True, False])
@torch.inference_mode()
def test_folding_batch_norm_changes_no_colour(norm: Norm, has_onednn: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linear, "HAS_ONEDNN", linear.HAS_ONEDNN and has_onednn)
    net, x = trained_net(norm)
    before = x.clone()
    expected = net(x)
    error = (net.folded()(x) - expected).abs().max() / expected.abs().max()
    assert error < 1e-5
    assert torch.equal(x, before)


@torch.inference_mode()
def test_bf16_agrees_to_a_hundredth_and_repeats() -> None:
    exact, x = trained_net("batch")
    net, _ = trained_net("batch", "bf16")
    net.load_state_dict(exact.state_dict())
    expected = exact(x)
    found = net.folded()(x)
    assert found.dtype == torch.float32
    assert 0 < (found - expected).abs().max() / expected.abs().max() < 1e-2
    assert torch.equal(found, net.folded()(x))


@pytest.mark.parametrize("share_empty", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("zero_layer", [False, True])
def test_pixels_without_layers_share_one_colour_and_all_others_keep_theirs(
    share_empty: float, zero_layer: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pixel_mlp, "find_kernels", lambda: None)  # They draw without the renderer's `forward`.
    torch.manual_seed(0)
    config = PaperConfig(texture_size=8, width=32, extrinsics="none", zero_layer=zero_layer)
    renderer = PaperRenderer(config, num_layers=3, num_objects=2, positions=None).eval()
    nn.init.normal_(renderer.textures.get_parameter("table"))
    is_empty = torch.rand(5000) < share_empty
    pixels = Pixels(
        uv=torch.randint(-(1 << 15), 1 << 15, (5000, 3, 2), dtype=torch.int16),
        object_id=torch.randint(1, 3, (5000, 3), dtype=torch.uint8) * ~is_empty[:, None],
        rgb=torch.zeros(5000, 3, dtype=torch.uint8),
        p_camera=torch.zeros(1, 3),
        pixels_per_view=5000,
    )
    drawn = 0

    def count(_: nn.Module, rays: tuple[object, ...]) -> None:
        nonlocal drawn
        drawn += len(rays[0].uv)  # pyright: ignore[reportAttributeAccessIssue]

    renderer.register_forward_pre_hook(count)
    found = predict_colors(renderer, pixels)
    assert drawn == -(-(int((~is_empty).sum()) + bool(is_empty.any())) // 1024) * 1024
    with torch.inference_mode():
        expected = renderer(pixels.take(torch.arange(5000), None))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


def test_a_network_in_bf16_learns_float32_parameters() -> None:
    net, x = trained_net("batch", "bf16")
    net.train()(x).square().mean().backward()
    assert all(item.grad is not None and item.grad.dtype == torch.float32 for item in net.parameters())


@pytest.mark.parametrize("rows", [1, 2, 333])
def test_a_linear_layer_equals_torchs_with_its_gradients(rows: int) -> None:
    torch.manual_seed(rows)
    ours, theirs = Linear(19, 7), nn.Linear(19, 7)
    theirs.load_state_dict(ours.state_dict())
    x = torch.randn(rows, 19)
    upstream = torch.randn(rows, 7)
    results = []
    for layer in (ours, theirs):
        own = x.clone().requires_grad_()
        y = layer(own)
        y.backward(upstream)
        assert own.grad is not None and layer.weight.grad is not None and layer.bias.grad is not None
        results.append((y.detach(), own.grad, layer.weight.grad, layer.bias.grad))
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


def test_a_linear_layer_repeats_bit_by_bit() -> None:
    torch.manual_seed(0)
    layer, x = Linear(96, 88), torch.randn(8192, 96)
    results = []
    for _ in range(3):
        layer.zero_grad()
        y = layer(x)
        y.square().sum().backward()
        assert layer.weight.grad is not None
        results.append((y.detach(), layer.weight.grad.clone()))
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))
