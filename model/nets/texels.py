"""The inner loops of neural textures on a CPU: weighted sums of four texels, and their gradients.

Compiled by Numba. The loops visit each slot of a stack of layers once, skip empty ones, and write directly into the
result, without the copies of texels that torch's own operations spend their time on. The remaining cost is memory
latency: each loop first lists the texels of a block of slots, and then prefetches them a few slots ahead.
"""

# Numba's extensions are untyped, and llvmlite has no stubs.
# pyright: reportMissingTypeStubs=false, reportCallIssue=false

from typing import Any

import numba
import numpy as np
from jaxtyping import Float32, Int32, UInt8
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from datagen.machine.compiled import compiled
from model.runtime import start_numba_threads

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
            w0, w1, w2, w3 = (
                weights[hit, 0] * scale,
                weights[hit, 1] * scale,
                weights[hit, 2] * scale,
                weights[hit, 3] * scale,
            )
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
