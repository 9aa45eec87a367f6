"""The only way from linear radiance to a picture: clip, the sRGB curve, 8 bits. No exposure, no tone curve."""

import numpy as np
from jaxtyping import Float, UInt8


def srgb_from_linear(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Display-referred values in [0, 1] of linear ones, clipped. Source: IEC 61966-2-1."""
    clipped = np.clip(linear, 0, 1)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * np.maximum(clipped, 1e-9) ** (1 / 2.4) - 0.055)


def linear_from_srgb(encoded: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """The inverse of `srgb_from_linear` on [0, 1]."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def to_8bit(encoded: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """Values in [0, 1] as 8 bits, rounded to nearest."""
    return np.rint(np.clip(encoded, 0, 1) * 255).astype(np.uint8)
