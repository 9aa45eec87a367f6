"""Tests of the neural texture's layout and lookup."""

import os
import subprocess
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from model.nets.texture import TextureLayout, level_scales, object_layout, sample, sample_by_bags


def look_up(table: Tensor, uv: Tensor, object_id: Tensor, layout: TextureLayout) -> Tensor:
    return sample([table], uv, object_id, [layout], [1.0])


def random_case(
    seed: int, num_objects: int, size: int, *, step: int = 0
) -> tuple[Tensor, Tensor, Tensor, TextureLayout]:
    """Each object's texture is `step` texels wider than the one before."""
    generator = torch.Generator().manual_seed(seed)
    sizes = [size + step * index for index in range(num_objects)]
    layout = object_layout(sizes)
    uv = torch.rand(13, 3, 2, generator=generator)
    uv[:4, 0] = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    object_id = torch.randint(0, num_objects + 1, (13, 3), generator=generator, dtype=torch.uint8)
    return torch.randn(layout.num_texels, 5, generator=generator), uv, object_id, layout


@settings(deadline=None, max_examples=40, derandomize=True)
@given(seed=st.integers(0, 1000), num_objects=st.integers(1, 7), size=st.integers(2, 33), step=st.integers(0, 3))
def test_lookup_and_its_gradient_equal_grid_sample_for_each_object(
    seed: int, num_objects: int, size: int, step: int
) -> None:
    table, uv, object_id, layout = random_case(seed, num_objects, size, step=step)
    upstream = torch.randn(13, 3, 5, generator=torch.Generator().manual_seed(seed))
    table.requires_grad_()
    own_uv = uv.clone().requires_grad_()
    features = look_up(table, own_uv, object_id, layout)
    features.backward(upstream)

    rows = table.detach().clone().requires_grad_()
    sizes = [size + step * index for index in range(num_objects)]
    images = rows.split([side**2 for side in sizes])
    uv.requires_grad_()
    grid = torch.stack([2 * uv[..., 0] - 1, 1 - 2 * uv[..., 1]], dim=-1)
    expected = torch.zeros(13, 3, 5)
    for index, (image, side) in enumerate(zip(images, sizes, strict=True)):
        picture = image.view(1, side, side, 5).permute(0, 3, 1, 2)
        looked_up = functional.grid_sample(picture, grid[None], padding_mode="border", align_corners=False)
        expected = expected + looked_up[0].permute(1, 2, 0) * (object_id == index + 1)[..., None]
    expected.backward(upstream)

    assert rows.grad is not None and table.grad is not None
    torch.testing.assert_close(features, expected, atol=2e-5, rtol=0)
    torch.testing.assert_close(table.grad, rows.grad, atol=2e-5, rtol=0)
    assert own_uv.grad is not None and uv.grad is not None
    # At a texel's centre and on the border the slope jumps, so rounding decides which side is meant.
    across = torch.tensor([1, *sizes])[object_id.int()][..., None]
    place = uv.detach() * across - 0.5
    is_smooth = ((place > 0) & (place < across - 1) & ((place - place.round()).abs() > 1e-4)).all(dim=-1)
    torch.testing.assert_close(own_uv.grad[is_smooth], uv.grad[is_smooth], atol=2e-4, rtol=1e-4)
    assert (own_uv.grad[object_id == 0] == 0).all()


def test_an_empty_layer_gives_exact_zeros_whatever_its_uv() -> None:
    table, uv, object_id, layout = random_case(0, 3, 8)
    features = look_up(table + 7, uv, object_id, layout)
    assert (features[object_id == 0] == 0).all() and (features[object_id != 0] != 0).all()
    nothing = look_up(table, uv, torch.zeros_like(object_id), layout)
    assert nothing.shape == (13, 3, 5) and (nothing == 0).all()


def test_lookup_and_dense_gradient_repeat_bit_by_bit() -> None:
    generator = torch.Generator().manual_seed(0)
    layout = object_layout((64, 64))
    uv = torch.rand(20_000, 4, 2, generator=generator)
    object_id = torch.randint(0, 3, (20_000, 4), generator=generator, dtype=torch.uint8)
    upstream = torch.randn(20_000, 4, 16, generator=generator)
    gradients = []
    for _ in range(3):
        table = torch.zeros(layout.num_texels, 16, requires_grad=True)
        look_up(table, uv, object_id, layout).backward(upstream)
        gradients.append(table.grad)
    assert torch.equal(gradients[0], gradients[1]) and torch.equal(gradients[0], gradients[2])


@pytest.mark.parametrize("channels", [1, 3, 8, 16])
def test_the_compiled_pyramid_equals_the_one_by_torchs_operations(channels: int) -> None:
    generator = torch.Generator().manual_seed(channels)
    layouts = [object_layout((16 >> level, 24 >> level, 9 >> level)) for level in range(3)]
    scales = level_scales(3, 0.5)
    assert scales == [0.25, 0.5, 1.0]
    uv = torch.rand(700, 4, 2, generator=generator)
    object_id = torch.randint(0, 4, (700, 4), generator=generator, dtype=torch.uint8)
    upstream = torch.randn(700, 4, channels, generator=generator)
    start = [torch.randn(layout.num_texels, channels, generator=generator) for layout in layouts]

    compiled = [table.clone().requires_grad_() for table in start]
    own_uv, plain_uv = (uv.clone().requires_grad_() for _ in range(2))
    features = sample(compiled, own_uv, object_id, layouts, scales)
    features.backward(upstream)

    plain = [table.clone().requires_grad_() for table in start]
    expected = sample_by_bags(plain, plain_uv.flatten(0, 1), object_id.flatten(), layouts, scales)
    expected.backward(upstream.flatten(0, 1))

    torch.testing.assert_close(features.flatten(0, 1), expected, atol=2e-6, rtol=1e-5)
    for table, other in zip(compiled, plain):
        assert table.grad is not None and other.grad is not None
        torch.testing.assert_close(table.grad, other.grad, atol=2e-5, rtol=1e-5)
    assert own_uv.grad is not None and plain_uv.grad is not None
    assert own_uv.grad.abs().max() > 1
    torch.testing.assert_close(own_uv.grad, plain_uv.grad, atol=1e-3, rtol=1e-4)


def test_look_ups_leave_torch_the_threads_that_it_was_told() -> None:
    """Numba's first parallel loop would set them to all cores, and sums over pixels would no longer repeat."""
    script = (
        "import torch; from model.nets.texture import object_layout, sample; "
        "uv, object_id = torch.rand(9, 1, 2), torch.ones(9, 1, dtype=torch.uint8); "
        "sample([torch.zeros(4, 3)], uv, object_id, [object_layout((2,))], [1]); "
        "print(torch.get_num_threads())"
    )
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1"]
