"""The inner loops of neural textures on a CPU: weighted sums of four texels, their gradients, and Adam for large ones.

Compiled by Numba. The loops visit each slot of a stack of layers once and write directly into the result. The cost is
memory latency: each loop first lists the texels of a block of slots, and then prefetches them a few slots ahead.

An update of `LazyAdam` costs as much as the texels that its rays meet, not as all texels. In dense Adam every texel
keeps moving by its momentum after the update that met it. Here a texel catches up when it is read next. Its gradient
was zero in the k updates since s, so m and v have decayed by b1^k and b2^k, and it has moved by m / sqrt(v) times the
sum of rate_u (b1 / sqrt(b2))^(u - s) over these updates u, which is kept for each s. This is dense Adam except for
rounding, and for the term 1e-8 beside sqrt(v), which stays as it was at s.
"""

# Numba's extensions are untyped, and llvmlite has no stubs.
# pyright: reportMissingTypeStubs=false, reportCallIssue=false

import math
from typing import Any, cast

import numba
import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, UInt8
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from torch import Tensor

from datagen.machine.compiled import compiled
from model.runtime import start_numba_threads
from model.state import State

start_numba_threads()

BLOCK = 1024
"""Slots that a thread takes at once."""

AHEAD = 16
"""Slots by which texels are prefetched."""


@numba.njit
def taps(uv, places, slot, place):
    """Rows of the four texels around a slot's point and their weights: those of `model.nets.texture.bilinear_taps`."""
    u, v = uv[slot, 0], uv[slot, 1]
    base, size, stride = places[0, place], places[1, place], places[2, place]
    last = np.float32(size - 1)
    x = min(max(u * np.float32(size) - np.float32(0.5), np.float32(0)), last)
    y = min(max((np.float32(1) - v) * np.float32(size) - np.float32(0.5), np.float32(0)), last)
    left, top = np.int32(x), np.int32(y)
    x, y = x - np.float32(left), y - np.float32(top)
    upper = base + top * stride
    lower = upper + (stride if top < size - 1 else 0)
    right = left + (1 if left < size - 1 else 0)
    over_x, over_y = np.float32(1) - x, np.float32(1) - y
    return (
        (upper + left, upper + right, lower + left, lower + right),
        (over_x * over_y, x * over_y, over_x * y, x * y),
    )


@numba.njit
def _list_hits(block, uv, object_id, places):
    """The slots of a block that are not empty, with rows and weights of their four texels; how many there are."""
    slots = np.empty(BLOCK, np.int32)
    rows, weights = np.empty((BLOCK, 4), np.int32), np.empty((BLOCK, 4), np.float32)
    count = 0
    for slot in range(block * BLOCK, min((block + 1) * BLOCK, len(object_id))):
        place = np.int32(object_id[slot]) - 1
        if place < 0:
            continue
        of_slot = taps(uv, places, slot, place)
        slots[count] = slot
        for tap in range(4):
            rows[count, tap], weights[count, tap] = of_slot[0][tap], of_slot[1][tap]
        count += 1
    return slots, rows, weights, count


@intrinsic
def fetch(typing_context: Any, table: Any, row: Any) -> Any:  # noqa: ARG001
    """Asks the processor for the beginning of a row of a table, and does not wait: LLVM's `prefetch`."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        index = context.cast(builder, arguments[1], signature.args[1], types.intp)
        place = [index, *(context.get_constant(types.intp, 0) for _ in range(signature.args[0].ndim - 1))]
        start = cgutils.get_item_pointer(context, builder, signature.args[0], array, place, wraparound=False)
        address, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        prefetch = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [address, number, number, number]), "llvm.prefetch.p0i8"
        )
        to_read, into_all_caches, data = number(0), number(3), number(1)
        builder.call(prefetch, [builder.bitcast(start, address), to_read, into_all_caches, data])
        return context.get_dummy_value()

    return types.void(table, row), generate


@numba.njit
def _fetch_ahead(table, rows, hit, count):
    """Begins to fetch the four texels of the hit that is `AHEAD` further on in a block's list."""
    if hit + AHEAD < count:
        for tap in range(4):
            fetch(table, rows[hit + AHEAD, tap])


@compiled(parallel=True, boundscheck=False)
def add_look_ups(
    result: Float32[np.ndarray, "slot c"],
    table: Float32[np.ndarray, "texel c"],
    uv: Float32[np.ndarray, "slot 2"],
    object_id: UInt8[np.ndarray, " slot"],
    places: Int32[np.ndarray, "3 object"],
    scale: np.float32,
) -> None:
    """Adds `scale` times the bilinear features of each slot; nothing where the slot is empty (object id 0).

    Args:
        places: first row, size and stride of each object's texture (`TextureLayout`).
    """
    num_slots, channels = result.shape
    for block in numba.prange((num_slots + BLOCK - 1) // BLOCK):
        slots, rows, weights, count = _list_hits(block, uv, object_id, places)
        for hit in range(count):
            _fetch_ahead(table, rows, hit, count)
            slot = slots[hit]
            r0, r1, r2, r3 = rows[hit, 0], rows[hit, 1], rows[hit, 2], rows[hit, 3]
            w0, w1 = weights[hit, 0] * scale, weights[hit, 1] * scale
            w2, w3 = weights[hit, 2] * scale, weights[hit, 3] * scale
            for c in range(channels):
                result[slot, c] += w0 * table[r0, c] + w1 * table[r1, c] + w2 * table[r2, c] + w3 * table[r3, c]


@compiled(boundscheck=False)
def add_gradient(
    gradient: Float32[np.ndarray, "texel c"],
    upstream: Float32[np.ndarray, "slot c"],
    uv: Float32[np.ndarray, "slot 2"],
    object_id: UInt8[np.ndarray, " slot"],
    places: Int32[np.ndarray, "3 object"],
    scale: np.float32,
) -> None:
    """Adds the gradient of `add_look_ups` with respect to its table, in slot order: sums repeat bit by bit."""
    num_slots, channels = upstream.shape
    for block in range((num_slots + BLOCK - 1) // BLOCK):
        slots, rows, weights, count = _list_hits(block, uv, object_id, places)
        for hit in range(count):
            _fetch_ahead(gradient, rows, hit, count)
            slot = slots[hit]
            for tap in range(4):
                row, share = rows[hit, tap], weights[hit, tap] * scale
                for c in range(channels):
                    gradient[row, c] += share * upstream[slot, c]


@compiled(parallel=True, boundscheck=False)
def add_uv_gradient(
    gradient: Float32[np.ndarray, "slot 2"],
    upstream: Float32[np.ndarray, "slot c"],
    table: Float32[np.ndarray, "texel c"],
    uv: Float32[np.ndarray, "slot 2"],
    object_id: UInt8[np.ndarray, " slot"],
    places: Int32[np.ndarray, "3 object"],
    scale: np.float32,
) -> None:
    """Adds the gradient of `add_look_ups` with respect to uv: the slope of the bilinear patch; 0 beyond the border."""
    num_slots, channels = upstream.shape
    for block in numba.prange((num_slots + BLOCK - 1) // BLOCK):
        slots, rows, weights, count = _list_hits(block, uv, object_id, places)
        for hit in range(count):
            _fetch_ahead(table, rows, hit, count)
            slot = slots[hit]
            size = places[1, np.int32(object_id[slot]) - 1]
            r0, r1, r2, r3 = rows[hit, 0], rows[hit, 1], rows[hit, 2], rows[hit, 3]
            # The weights are products (1 - x)(1 - y), x (1 - y), (1 - x) y, x y.
            x, y = weights[hit, 1] + weights[hit, 3], weights[hit, 2] + weights[hit, 3]
            along_x = along_y = np.float32(0)
            for c in range(channels):
                t0, t1, t2, t3 = table[r0, c], table[r1, c], table[r2, c], table[r3, c]
                along_x += upstream[slot, c] * ((np.float32(1) - y) * (t1 - t0) + y * (t3 - t2))
                along_y += upstream[slot, c] * ((np.float32(1) - x) * (t2 - t0) + x * (t3 - t1))
            half, last = np.float32(0.5), np.float32(size) - np.float32(0.5)
            across, down = uv[slot, 0] * np.float32(size), (np.float32(1) - uv[slot, 1]) * np.float32(size)
            if half <= across <= last:
                gradient[slot, 0] += scale * np.float32(size) * along_x
            if half <= down <= last:
                gradient[slot, 1] -= scale * np.float32(size) * along_y


BETA2, EPSILON = 0.999, 1e-8

Moved = tuple[
    Float32[np.ndarray, "texel c"],
    Float32[np.ndarray, "texel c"],
    Float32[np.ndarray, "texel c"],
    Int32[np.ndarray, " texel"],
    int,
    Float64[np.ndarray, "update 4"],
]
"""Table, means, squares, and update up to which each texel has been moved; number of updates, and their history."""

LEAST_SHARE = 1e-9
"""Share of a momentum below which it moves a texel no more."""


class LazyAdam:
    """The optimiser's state of one table of texels, the table's gradient, and the texels that this update has read."""

    def __init__(self, table: Float32[Tensor, "texel c"], *, beta1: float) -> None:
        self._table = table
        self.gradient = torch.zeros_like(table, requires_grad=False)
        """Zero except for texels that the current update has read."""
        self.added = 0.0
        """Sum of the upstream gradients that the current update has added to it."""
        self._mean, self._square = torch.zeros_like(self.gradient), torch.zeros_like(self.gradient)
        self._current = torch.zeros(len(table), dtype=torch.int32)
        """Update up to which a texel has been moved, by texel."""
        self._is_read = np.zeros(len(table), np.uint8)
        self._read, self._num_read = np.empty(len(table), np.int32), 0
        self._beta1, self._ratio = beta1, beta1 / math.sqrt(BETA2)
        self._updates = 0
        self._history = np.zeros((0, 4))
        """By update: the sum of rates times powers of `_ratio` since then; and by number of updates, what is left of a
        mean and of a square, and Adam's 1e-8 as it counts after this update."""
        self._lengthen(1024)

    def read(
        self,
        uv: Float32[np.ndarray, "slot 2"],
        object_id: UInt8[np.ndarray, " slot"],
        places: Int32[np.ndarray, "3 object"],
        *,
        is_training: bool,
    ) -> None:
        """Moves the texels around these points to where they are now; in training they will have a gradient."""
        self._num_read = _read_texels(
            uv, object_id, places, self._moved(), self._is_read, self._read, self._num_read, is_training
        )

    def is_finite(self) -> bool:
        """Whether the gradient is; each texel's is a weighted sum of upstream gradients."""
        return math.isfinite(self.added)

    def step(self, rate: float) -> None:
        """Adam's step for the texels that were read, whose gradient is zero afterwards."""
        self._updates += 1
        now = self._updates
        if now >= len(self._history):
            self._lengthen(2 * now)
        first_share, second_share = 1 - self._beta1**now, 1 - BETA2**now
        rate *= math.sqrt(second_share) / first_share
        if self._ratio > 0:
            reach = min(now, math.ceil(math.log(LEAST_SHARE) / math.log(self._ratio)))
            powers = self._ratio ** np.arange(reach, 0, -1)
            self._history[now - reach : now, 0] += rate * powers
        read = self._read[: self._num_read]
        rates = np.float32(rate), np.float32(self._beta1)
        _step_rows(self._moved(), self.gradient.numpy(), self._is_read, read, *rates)
        self._num_read, self.added = 0, 0.0

    def catch_up(self) -> None:
        """Moves all texels to where they are now."""
        _catch_up(self._moved(), np.arange(len(self._table), dtype=np.int32))

    def state(self) -> State:
        """State for a checkpoint; the table is stored as is, with pending updates."""
        return {
            "mean": self._mean,
            "square": self._square,
            "current": self._current,
            "sums": torch.from_numpy(self._history[: self._updates + 1, 0].copy()),
        }

    def load_state(self, state: State) -> None:
        found = cast(dict[str, Tensor], state)
        self._mean.copy_(found["mean"])
        self._square.copy_(found["square"])
        self._current.copy_(found["current"])
        self._updates = len(found["sums"]) - 1
        self._lengthen(self._updates + 1024)
        self._history[:, 0] = 0
        self._history[: self._updates + 1, 0] = found["sums"].numpy()

    def _lengthen(self, length: int) -> None:
        number = np.arange(length)
        sums = np.zeros(length)
        sums[: len(self._history)] = self._history[:length, 0]
        # Without denormal numbers, which are slow.
        left = [np.where(decay**number > LEAST_SHARE**2, decay**number, 0) for decay in (self._beta1, BETA2)]
        self._history = np.stack([sums, *left, EPSILON * np.sqrt(1 - BETA2**number)], axis=1)

    def _moved(self) -> Moved:
        return (
            self._table.detach().numpy(),
            self._mean.numpy(),
            self._square.numpy(),
            self._current.numpy(),
            self._updates,
            self._history,
        )


@compiled()
def _catch_up(moved: Moved, rows: Int32[np.ndarray, " row"]) -> None:
    """Moves texels by their momentum in the updates since each was current.

    Their moments are rarely in a cache: they are fetched ahead instead of waited for. A call for each texel would take
    six times as long, since it counts references to all arrays.
    """
    table, mean, square, current, updates, history = moved
    for place in range(len(rows)):
        if place + AHEAD < len(rows):
            ahead = rows[place + AHEAD]
            fetch(table, ahead)
            fetch(mean, ahead)
            fetch(square, ahead)
        row = rows[place]
        since = current[row]
        current[row] = updates
        if since in (updates, 0):
            continue
        way, epsilon = np.float32(history[since, 0]), np.float32(history[since, 3])
        kept_mean, kept_square = np.float32(history[updates - since, 1]), np.float32(history[updates - since, 2])
        for c in range(table.shape[1]):
            table[row, c] -= way * mean[row, c] / (np.sqrt(square[row, c]) + epsilon)
            mean[row, c] *= kept_mean
            square[row, c] *= kept_square


@compiled()
def _read_texels(
    uv: Float32[np.ndarray, "slot 2"],
    object_id: UInt8[np.ndarray, " slot"],
    places: Int32[np.ndarray, "3 object"],
    moved: Moved,
    is_read: UInt8[np.ndarray, " texel"],
    read: Int32[np.ndarray, " texel"],
    num_read: int,
    is_training: bool,
) -> int:
    """Lists the texels around points, each once in an update, and lets them catch up; returns how many are listed."""
    first = num_read
    for slot in range(len(object_id)):
        place = np.int32(object_id[slot]) - 1
        if place < 0:
            continue
        rows, _ = taps(uv, places, slot, place)
        for tap in range(4):
            row = rows[tap]
            if not is_read[row]:
                is_read[row] = 1
                read[num_read] = row
                num_read += 1
    _catch_up(moved, read[first:num_read])
    if is_training:
        return num_read
    for row in read[first:num_read]:
        is_read[row] = 0
    return first


@compiled()
def _step_rows(
    moved: Moved,
    gradient: Float32[np.ndarray, "texel c"],
    is_read: UInt8[np.ndarray, " texel"],
    rows: Int32[np.ndarray, " row"],
    rate: np.float32,
    beta1: np.float32,
) -> None:
    table, mean, square, current, update, history = moved
    one, beta2, epsilon = np.float32(1), np.float32(BETA2), np.float32(history[update, 3])
    for place in range(len(rows)):
        if place + AHEAD < len(rows):
            ahead = rows[place + AHEAD]
            fetch(table, ahead)
            fetch(mean, ahead)
            fetch(square, ahead)
            fetch(gradient, ahead)
        row = rows[place]
        for c in range(table.shape[1]):
            slope = gradient[row, c]
            mean[row, c] = beta1 * mean[row, c] + (one - beta1) * slope
            square[row, c] = beta2 * square[row, c] + (one - beta2) * slope * slope
            table[row, c] -= rate * mean[row, c] / (np.sqrt(square[row, c]) + epsilon)
            gradient[row, c] = 0
        current[row] = update
        is_read[row] = 0
