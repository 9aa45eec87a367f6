"""Neural textures: where an object's texels lie in one packed table, and the bilinear lookup of layers in it."""

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from jaxtyping import Float32, Int32, UInt8
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx
from torch.nn import functional

from datagen.disk.errors import NumericsError
from model.nets.texels import LazyAdam, add_gradient, add_look_ups, add_uv_gradient


@dataclass(frozen=True, kw_only=True)
class TextureLayout:
    """Square images of texels inside one table with a row per texel."""

    bases: tuple[int, ...]
    """Row of each object's texel (0, 0); object id 1 comes first."""
    sizes: tuple[int, ...]
    """Width and height of each object's image in texels."""
    strides: tuple[int, ...]
    """Rows of the table from one texel of an object to the one below it."""
    num_texels: int


def object_layout(sizes: Sequence[int]) -> TextureLayout:
    """A texture of `sizes[k]` texels squared for object k + 1, one after the other."""
    *bases, num_texels = itertools.accumulate((size * size for size in sizes), initial=0)
    return TextureLayout(bases=tuple(bases), sizes=tuple(sizes), strides=tuple(sizes), num_texels=num_texels)


def bilinear_taps(
    uv: Float32[Tensor, "hit 2"], object_id: UInt8[Tensor, " hit"], *layouts: TextureLayout
) -> tuple[Int32[Tensor, "hit tap"], Float32[Tensor, "hit tap"]]:
    """Rows of the four texels around each point in each layout's table, and their weights, which sum to 1 in each.

    Rows count on through the tables, one after the other. Texel (row r, column c) has its centre at u = (c + 0.5) /
    size, v = 1 - (r + 0.5) / size. Outside the outermost centres the border texel goes on:
    `grid_sample(align_corners=False, padding_mode="border")`.
    """
    base, size, stride = places_on(layouts, uv.device)[:, object_id.int() - 1]
    return taps_around(torch.stack([uv[:, 0], 1 - uv[:, 1]])[..., None] * size - 0.5, base, size - 1, stride)


def taps_around(
    place: Float32[Tensor, "2 hit table"],
    base: Int32[Tensor, "*#b"],
    last: Int32[Tensor, "*#c"],
    stride: Int32[Tensor, "*#b"],
) -> tuple[Int32[Tensor, "hit tap"], Float32[Tensor, "hit tap"]]:
    """`bilinear_taps` of columns and rows, counted in texels from the centre of each table's first one.

    Args:
        last: columns and rows of the last texels.

    All tables are looked up at once: on a GPU, each operation is a launch.
    """
    place = torch.minimum(place.clamp_min(0), last)
    corner = place.int()
    further = place - corner
    has_next = corner < last
    column = torch.stack([corner[0], corner[0] + has_next[0]], dim=-1)
    upper = base + corner[1] * stride
    row = torch.stack([upper, upper + stride * has_next[1]], dim=-1)
    texels = row[..., :, None] + column[..., None, :]
    across, down = torch.stack([1 - further, further], dim=-1)
    return texels.flatten(1), (down[..., :, None] * across[..., None, :]).flatten(1)


@functools.cache
def places_on(layouts: tuple[TextureLayout, ...], device: torch.device) -> Int32[Tensor, "3 object layout"]:
    """`places_of` each layout on a device; first rows count on through the tables."""
    places = np.stack([places_of(layout) for layout in layouts], axis=-1)
    places[0] += np.array(list(itertools.accumulate((each.num_texels for each in layouts[:-1]), initial=0)), np.int32)
    with torch.inference_mode(False):
        return torch.from_numpy(places).to(device)


@functools.cache
def constant_on(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Numbers on a device, where a copy for every look-up would wait for the processor."""
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype).to(device)


def texel_centers(size: int) -> Float32[Tensor, "texel 2"]:
    """uv of the centres of a square image's texels, row by row from the top."""
    place = (torch.arange(size) + 0.5) / size
    v, u = torch.meshgrid(1 - place, place, indexing="ij")
    return torch.stack([u, v], dim=-1).flatten(0, 1)


def sample(
    tables: Sequence[Float32[Tensor, "_ c"]],
    uv: Float32[Tensor, "ray layer 2"],
    object_id: UInt8[Tensor, "ray layer"],
    layouts: Sequence[TextureLayout],
    scales: Sequence[float],
    lazy: Sequence[LazyAdam | None] = (),
) -> Float32[Tensor, "ray layer c"]:
    """The scaled sum of the bilinear features of every layer in several tables; zeros where it is empty (object id 0).

    Gradients flow to tables and uv. They are summed in a fixed order, so that a run on a CPU repeats bit by bit.

    Args:
        lazy: for each table what moves its texels, and gets its gradient instead of autograd; None: autograd.
    """
    slots = uv.flatten(0, 1), object_id.flatten()
    # On a GPU such a uv makes the loss NaN; compiled loops would use it as the position of some texel.
    if uv.device.type == "cpu" and not math.isfinite(uv.detach().sum().item()):
        raise NumericsError("uv: a layer has one that is not finite; check the data with `datagen verify`")
    if uv.device.type != "cpu":
        features = sample_by_bags(tables, *slots, layouts, scales)
    else:
        owners = tuple(lazy) or (None,) * len(tables)
        features = _CompiledSample.apply(*slots, layouts, scales, owners, torch.is_grad_enabled(), *tables)
    return features.view(*object_id.shape, tables[0].shape[1])


class _CompiledSample(torch.autograd.Function):
    """`sample` by the loops of `model.nets.texels`. Gradients are off inside, so `sample` passes `is_training`."""

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        uv: Tensor,
        object_id: Tensor,
        layouts: Sequence[TextureLayout],
        scales: Sequence[float],
        lazy: tuple[LazyAdam | None, ...],
        is_training: bool,
        *tables: Tensor,
    ) -> Tensor:
        ctx.save_for_backward(uv, object_id, *tables)
        ctx.lazy = lazy  # pyright: ignore[reportAttributeAccessIssue]
        ctx.levels = [(places_of(layout), np.float32(scale)) for layout, scale in zip(layouts, scales, strict=True)]  # pyright: ignore[reportAttributeAccessIssue]
        result = torch.zeros(len(object_id), tables[0].shape[1])
        slots = uv.detach().contiguous().numpy(), object_id.numpy()
        for table, owner, (places, scale) in zip(tables, lazy, ctx.levels, strict=True):  # pyright: ignore[reportAttributeAccessIssue]
            if owner is not None:
                owner.read(*slots, places, is_training=is_training)
            add_look_ups(result.numpy(), table.detach().contiguous().numpy(), *slots, places, scale)
        return result

    @staticmethod
    def backward(ctx: FunctionCtx, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        uv, object_id, *tables = ctx.saved_tensors  # pyright: ignore[reportAttributeAccessIssue]
        above = upstream[0].contiguous().numpy()
        slots = uv.detach().contiguous().numpy(), object_id.numpy()
        lazy = ctx.lazy  # pyright: ignore[reportAttributeAccessIssue]
        gradients = [
            torch.zeros(table.shape) if owner is None else owner.gradient
            for table, owner in zip(tables, lazy, strict=True)
        ]
        uv_gradient = torch.zeros(uv.shape) if ctx.needs_input_grad[0] else None  # pyright: ignore[reportAttributeAccessIssue]
        for table, gradient, (places, scale) in zip(tables, gradients, ctx.levels, strict=True):  # pyright: ignore[reportAttributeAccessIssue]
            add_gradient(gradient.numpy(), above, *slots, places, scale)
            if uv_gradient is not None:
                texels = table.detach().contiguous().numpy()
                add_uv_gradient(uv_gradient.numpy(), above, texels, *slots, places, scale)
        total = upstream[0].sum().item() if any(lazy) else 0.0
        for owner in lazy:
            if owner is not None:
                owner.added += total
        kept = [gradient if owner is None else None for gradient, owner in zip(gradients, lazy, strict=True)]
        return uv_gradient, *[None] * 5, *kept


@functools.cache
def places_of(layout: TextureLayout) -> Int32[np.ndarray, "3 object"]:
    """First row, size and stride of each object's texture, as compiled loops read them."""
    return np.array([layout.bases, layout.sizes, layout.strides], np.int32)


def sample_by_bags(
    tables: Sequence[Float32[Tensor, "_ c"]],
    uv: Float32[Tensor, "slot 2"],
    object_id: UInt8[Tensor, " slot"],
    layouts: Sequence[TextureLayout],
    scales: Sequence[float],
) -> Float32[Tensor, "slot c"]:
    """`sample` by torch's operations on any device, all tables at once.

    Empty slots are looked up with weights of zero: finding the others would make a GPU wait for the processor.
    """
    is_hit = (object_id != 0)[:, None]
    texels, weights = bilinear_taps(torch.where(is_hit, uv, 0), object_id, *layouts)
    scale = constant_on(tuple(scale for scale in scales for _ in range(4)), torch.float32, uv.device)
    table = tables[0] if len(tables) == 1 else torch.cat(list(tables))
    return sum_texels(table, texels, torch.where(is_hit, weights * scale, 0))


def sum_texels(
    table: Float32[Tensor, "texel c"], texels: Int32[Tensor, "slot tap"], weights: Float32[Tensor, "slot tap"]
) -> Float32[Tensor, "slot c"]:
    """The sum of some weighted rows of a table for each slot, by torch's operations on any device.

    A GPU sorts the texels for the table's gradient, which therefore repeats bit by bit: 0.3 to 1 ms on an H100 for the
    look-ups of an update. `index_add` takes a quarter of that, and three to five times as long where it has to repeat.
    """
    return functional.embedding_bag(texels, table, mode="sum", per_sample_weights=weights)


class NeuralTextures(nn.Module):
    """Learned features on the surface of every object: one table of texels, all trained together."""

    def __init__(self, layout: TextureLayout, features: int, *, start: float = 0.0) -> None:
        """A table of equal features.

        The paper names no initial value. With zeros, a texel that no training ray touched stays neutral: 0.6 dB better
        than the authors' 0.5 on the glass table.
        """
        super().__init__()
        self.layout = layout
        self.table = nn.Parameter(torch.full((self.layout.num_texels, features), start))
        self.lazy: LazyAdam | None = None
        """What moves the texels while training; None: the optimiser of all other parameters."""

    def forward(
        self, uv: Float32[Tensor, "ray layer 2"], object_id: UInt8[Tensor, "ray layer"]
    ) -> Float32[Tensor, "ray layer c"]:
        return sample([self.table], uv, object_id, [self.layout], [1.0], [self.lazy])


class TexturePyramid(nn.ModuleList):
    """Textures of one surface whose features are summed, finest first, each half as wide as the one before.

    Source: hierarchical neural textures, Thies et al. 2019 (arXiv 1904.12356): what few rays have met is filled in from
    around it. A list, so that level k's table is named `k.table`.
    """

    def __init__(
        self, layouts: Sequence[TextureLayout], features: int, *, finer_counts: float = 1.0, start: float = 0.0
    ) -> None:
        """`finer_counts`: a level's weight by the next coarser one's; the coarsest has 1, and begins at `start`."""
        super().__init__(
            NeuralTextures(layout, features, start=start if layout is layouts[-1] else 0.0) for layout in layouts
        )
        self.finer_counts = finer_counts

    def forward(
        self, uv: Float32[Tensor, "ray layer 2"], object_id: UInt8[Tensor, "ray layer"]
    ) -> Float32[Tensor, "ray layer c"]:
        layouts = [level.layout for level in self.levels()]
        lazy = [level.lazy for level in self.levels()]
        return sample(self.tables(), uv, object_id, layouts, level_scales(len(self), self.finer_counts), lazy)

    def tables(self) -> list[Float32[Tensor, "_ c"]]:
        """The texels of each level, finest first."""
        return [level.table for level in self.levels()]

    def levels(self) -> "list[NeuralTextures]":
        return cast(list[NeuralTextures], list(self))


def level_scales(num_levels: int, finer_counts: float) -> list[float]:
    """The weight of each level of a pyramid, finest first: `finer_counts` times that of the next coarser one."""
    return [finer_counts ** (num_levels - 1 - level) for level in range(num_levels)]
