"""Owns the inner loops of neural textures on a CPU: weighted sums of four texels, and their gradients.

Compiled by Numba. The loops visit each slot of a stack of layers once, skip the empty ones, and write straight into
the result: no copy of texels, rows or weights is ever made, which is what torch's own operations spend their time on.
"""

import numba
import numpy as np
from jaxtyping import Float32, Int32, UInt8

from model.runtime import start_numba_threads

start_numba_threads()

BLOCK = 1024
"""Slots that a thread takes at once."""

STRIPE = 6
"""Stripes of 2^6 texels in turn belong to each thread while the gradient is summed."""


@numba.njit
def _taps(uv, places, slot, place):
    """Rows of the four texels around a slot's point and their weights: those of `model.texture.bilinear_taps`."""
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


@numba.njit(parallel=True, cache=True, boundscheck=False)
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
        for slot in range(block * BLOCK, min((block + 1) * BLOCK, num_slots)):
            place = np.int32(object_id[slot]) - 1
            if place < 0:
                continue
            rows, weights = _taps(uv, places, slot, place)
            w0, w1, w2, w3 = weights[0] * scale, weights[1] * scale, weights[2] * scale, weights[3] * scale
            for c in range(channels):
                result[slot, c] += (
                    w0 * table[rows[0], c] + w1 * table[rows[1], c] + w2 * table[rows[2], c] + w3 * table[rows[3], c]
                )


@numba.njit(parallel=True, cache=True, boundscheck=False)
def add_gradient(
    gradient: Float32[np.ndarray, "texel c"],
    upstream: Float32[np.ndarray, "slot c"],
    uv: Float32[np.ndarray, "slot 2"],
    object_id: UInt8[np.ndarray, " slot"],
    places: Int32[np.ndarray, "3 object"],
    scale: np.float32,
    parts: int,
) -> None:
    """Adds the gradient of `add_look_ups` with respect to its table.

    Args:
        parts: threads that share the work. Each looks at all slots and adds to its own stripes of texels, so that every
            texel's sum is taken in the order of the slots: the same bits for any number of them, without locks.
    """
    num_slots, channels = upstream.shape
    for part in numba.prange(parts):
        for slot in range(num_slots):
            place = np.int32(object_id[slot]) - 1
            if place < 0:
                continue
            rows, weights = _taps(uv, places, slot, place)
            for tap in range(4):
                row = rows[tap]
                if (row >> STRIPE) % parts == part:
                    weight = weights[tap] * scale
                    for c in range(channels):
                        gradient[row, c] += weight * upstream[slot, c]


@numba.njit(parallel=True, cache=True, boundscheck=False)
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
        for slot in range(block * BLOCK, min((block + 1) * BLOCK, num_slots)):
            place = np.int32(object_id[slot]) - 1
            if place < 0:
                continue
            size = places[1, place]
            rows, weights = _taps(uv, places, slot, place)
            # The weights are products (1 - x)(1 - y), x (1 - y), (1 - x) y, x y.
            x, y = weights[1] + weights[3], weights[2] + weights[3]
            along_x = along_y = np.float32(0)
            for c in range(channels):
                t0, t1, t2, t3 = table[rows[0], c], table[rows[1], c], table[rows[2], c], table[rows[3], c]
                along_x += upstream[slot, c] * ((np.float32(1) - y) * (t1 - t0) + y * (t3 - t2))
                along_y += upstream[slot, c] * ((np.float32(1) - x) * (t2 - t0) + x * (t3 - t1))
            half, last = np.float32(0.5), np.float32(size) - np.float32(0.5)
            across, down = uv[slot, 0] * np.float32(size), (np.float32(1) - uv[slot, 1]) * np.float32(size)
            if half <= across <= last:
                gradient[slot, 0] += scale * np.float32(size) * along_x
            if half <= down <= last:
                gradient[slot, 1] -= scale * np.float32(size) * along_y
