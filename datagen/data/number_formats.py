"""The number formats of stored layers: how few bits each quantity keeps, and the largest error of that."""

import numpy as np
from jaxtyping import Float32, UInt16

UV_SCALE = 65535


def quantize_uv(uv: Float32[np.ndarray, "*shape 2"]) -> UInt16[np.ndarray, "*shape 2"]:
    """16-bit uv; the error is at most 7.6e-6, 0.03 of a texel even at 4096 texels."""
    return np.rint(np.clip(uv.astype(np.float64), 0, 1) * UV_SCALE).astype(np.uint16)


def round_mantissa(values: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Floats with 16 of their 23 mantissa bits, rounded to nearest; relative error at most 7.7e-6."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + np.uint32(0x40)) & np.uint32(0xFFFFFF80)).view(np.float32)
