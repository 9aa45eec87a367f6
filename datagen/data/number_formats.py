"""The number formats of stored layers: how few bits each quantity keeps, and the largest error of that."""

import numpy as np
from jaxtyping import Float32, Int16, UInt16

UV_SCALE = 65535
DIRECTION_SCALE = 32767


def quantize_uv(uv: Float32[np.ndarray, "*shape 2"]) -> UInt16[np.ndarray, "*shape 2"]:
    """16-bit uv; the error is at most 7.6e-6, 0.03 of a texel even at 4096 texels."""
    return np.rint(np.clip(uv.astype(np.float64), 0, 1) * UV_SCALE).astype(np.uint16)


def round_mantissa(values: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Floats with 16 of their 23 mantissa bits, rounded to nearest; relative error at most 7.7e-6."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + np.uint32(0x40)) & np.uint32(0xFFFFFF80)).view(np.float32)


def encode_directions(directions: Float32[np.ndarray, "*shape 3"]) -> Int16[np.ndarray, "*shape 2"]:
    """Unit vectors as points of an unfolded octahedron, 16 bits each way; off by at most 6.5e-5 rad when decoded.

    Source: Cigolle et al. 2014, A Survey of Efficient Representations for Independent Unit Vectors, `oct32`.
    """
    d = directions.astype(np.float64)
    d /= np.abs(d).sum(axis=-1, keepdims=True)
    # The lower half is folded outwards over the edges of the upper one.
    folded = (1 - np.abs(d[..., [1, 0]])) * np.where(d[..., :2] >= 0, 1, -1)
    plane = np.where(d[..., 2:] < 0, folded, d[..., :2])
    return np.rint(plane * DIRECTION_SCALE).astype(np.int16)


def decode_directions(codes: Int16[np.ndarray, "*shape 2"]) -> Float32[np.ndarray, "*shape 3"]:
    """Unit vectors of `encode_directions`."""
    plane = codes.astype(np.float32) / DIRECTION_SCALE
    z = 1 - np.abs(plane).sum(axis=-1, keepdims=True)
    unfolded = plane - np.maximum(-z, 0) * np.where(plane >= 0, np.float32(1), np.float32(-1))
    d = np.concatenate([unfolded, z], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)
