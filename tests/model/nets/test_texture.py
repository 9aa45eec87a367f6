"""Tests of the neural texture's layout and lookup."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from model.nets.texture import TextureLayout, level_scales, object_layout, sample, sample_by_bags


def slow_sample(table: np.ndarray, uv: np.ndarray, object_id: np.ndarray, layout: TextureLayout) -> np.ndarray:
    """Oracle: one ray, one layer and one neighbour at a time, in float64."""
    features = np.zeros((*object_id.shape, table.shape[1]))
    for ray, layer in np.ndindex(object_id.shape):
        if object_id[ray, layer] == 0:
            continue
        u, v = uv[ray, layer].astype(np.float64)
        size, stride = layout.sizes[object_id[ray, layer] - 1], layout.strides[object_id[ray, layer] - 1]
        x, y = u * size - 0.5, (1 - v) * size - 0.5
        for column in (math.floor(x), math.floor(x) + 1):
            for row in (math.floor(y), math.floor(y) + 1):
                weight = (1 - abs(x - column)) * (1 - abs(y - row))
                inside_row = min(max(row, 0), size - 1)
                inside_column = min(max(column, 0), size - 1)
                texel = layout.bases[object_id[ray, layer] - 1] + inside_row * stride + inside_column
                features[ray, layer] += weight * table[texel]
    return features


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
@given(
    seed=st.integers(0, 1000),
    num_objects=st.integers(1, 7),
    size=st.integers(6, 17),
    step=st.integers(0, 3),
)
def test_lookup_equals_a_slow_loop(seed: int, num_objects: int, size: int, step: int) -> None:
    table, uv, object_id, layout = random_case(seed, num_objects, size, step=step)
    expected = slow_sample(table.numpy(), uv.numpy(), object_id.numpy(), layout)
    np.testing.assert_allclose(look_up(table, uv, object_id, layout).numpy(), expected, atol=2e-5)


@settings(deadline=None, max_examples=40, derandomize=True)
@given(seed=st.integers(0, 1000), num_objects=st.integers(1, 4), size=st.integers(2, 33))
def test_lookup_and_its_gradient_equal_grid_sample_for_each_object(seed: int, num_objects: int, size: int) -> None:
    table, uv, object_id, layout = random_case(seed, num_objects, size)
    upstream = torch.randn(13, 3, 5, generator=torch.Generator().manual_seed(seed))
    table.requires_grad_()
    own_uv = uv.clone().requires_grad_()
    features = look_up(table, own_uv, object_id, layout)
    features.backward(upstream)

    images = table.detach().view(num_objects, size, size, 5).permute(0, 3, 1, 2).clone().requires_grad_()
    uv.requires_grad_()
    grid = torch.stack([2 * uv[..., 0] - 1, 1 - 2 * uv[..., 1]], dim=-1)
    expected = torch.zeros(13, 3, 5)
    for index in range(num_objects):
        looked_up = functional.grid_sample(
            images[index : index + 1], grid[None], padding_mode="border", align_corners=False
        )
        expected = expected + looked_up[0].permute(1, 2, 0) * (object_id == index + 1)[..., None]
    expected.backward(upstream)

    assert images.grad is not None and table.grad is not None
    torch.testing.assert_close(features, expected, atol=2e-5, rtol=0)
    by_texel = images.grad.permute(0, 2, 3, 1).reshape(-1, 5)
    torch.testing.assert_close(table.grad, by_texel, atol=2e-5, rtol=0)
    assert own_uv.grad is not None and uv.grad is not None
    # At a texel's centre and on the border the slope jumps, so rounding decides which side is meant.
    place = uv.detach() * size - 0.5
    is_smooth = ((place > 0) & (place < size - 1) & ((place - place.round()).abs() > 1e-4)).all(dim=-1)
    torch.testing.assert_close(own_uv.grad[is_smooth], uv.grad[is_smooth], atol=2e-4, rtol=1e-4)
    assert (own_uv.grad[object_id == 0] == 0).all()


def test_an_empty_layer_gives_exact_zeros_whatever_its_uv() -> None:
    table, uv, object_id, layout = random_case(0, 3, 8)
    features = look_up(table + 7, uv, object_id, layout)
    assert (features[object_id == 0] == 0).all() and (features[object_id != 0] != 0).all()
    nothing = look_up(table, uv, torch.zeros_like(object_id), layout)
    assert nothing.shape == (13, 3, 5) and (nothing == 0).all()


def test_a_gradient_reaches_only_the_four_texels_around_a_hit() -> None:
    layout = object_layout((8, 8))
    table = torch.zeros(layout.num_texels, 4, requires_grad=True)
    # Between texel rows 2 and 3 (v = 1 - 3 / 8) and columns 5 and 6 (u = 6 / 8) of the second object.
    uv = torch.tensor([[[6 / 8, 1 - 3 / 8], [0.2, 0.2]]])
    look_up(table, uv, torch.tensor([[2, 0]], dtype=torch.uint8), layout).sum().backward()
    assert table.grad is not None
    touched = table.grad[:, 0].view(2, 8, 8).nonzero().tolist()
    assert touched == [[1, 2, 5], [1, 2, 6], [1, 3, 5], [1, 3, 6]]
    assert table.grad[touched[0][0] * 64 + 2 * 8 + 5].tolist() == [0.25] * 4


def test_permuting_objects_permutes_textures() -> None:
    table, uv, object_id, layout = random_case(3, 4, 6)
    order = torch.tensor([2, 0, 3, 1])  # The new object k is the old object order[k].
    permuted_table = table.view(4, 36, 5)[order].reshape(-1, 5)
    new_id = torch.cat([torch.zeros(1), torch.argsort(order) + 1]).to(torch.uint8)
    permuted = look_up(permuted_table, uv, new_id[object_id.long()], layout)
    assert torch.equal(permuted, look_up(table, uv, object_id, layout))


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
