"""Bilinear look-ups in pictures."""

import numpy as np
from jaxtyping import Float, Float32


def bilinear(
    pixels: Float32[np.ndarray, "tex_h tex_w 3"],
    across: Float[np.ndarray, "*point"],
    down: Float[np.ndarray, "*point"],
    *,
    wraps: tuple[bool, bool],
) -> Float[np.ndarray, "*point 3"]:
    """Colours at points of a picture, as Mitsuba looks them up.

    Args:
        across: shares of the picture's width from its left side; the first column has its centre at 0.5 / width.
        down: shares of its height from its upper side.
        wraps: whether the picture repeats across, and down; otherwise its border goes on.
    """
    height, width = pixels.shape[:2]
    (left, right), right_share = _neighbours(across, width, wraps=wraps[0])
    rows, low_share = _neighbours(down, height, wraps=wraps[1])
    upper, lower = (pixels[row, left] * (1 - right_share) + pixels[row, right] * right_share for row in rows)
    return upper * (1 - low_share) + lower * low_share


def _neighbours(place: np.ndarray, size: int, *, wraps: bool) -> tuple[list[np.ndarray], np.ndarray]:
    """The two pixels of a line between which points lie, and the share of the second."""
    pixel = place * size - 0.5
    first = np.floor(pixel).astype(np.int64)
    sides = [index % size if wraps else np.clip(index, 0, size - 1) for index in (first, first + 1)]
    return sides, (pixel - first)[..., None]
