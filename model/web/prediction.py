"""What is left of a texture's whole numbers when each is guessed from its neighbours: little, which deflates well."""

import numpy as np
from jaxtyping import Bool, Int32


def residuals(codes: Int32[np.ndarray, "h w c"], counts: Bool[np.ndarray, "h w"]) -> Int32[np.ndarray, "h w c"]:
    """How each number differs from its guess: left plus above less above left, but not beyond left and above.

    Args:
        counts: texels that matter. The others become their guess, so that nothing is left of them.

    Source: the predictor of LOCO-I (Weinberger et al. 2000). floats.js reads it back.
    """
    height, width, _ = codes.shape
    known, left_over = codes.copy(), np.zeros_like(codes)
    # All texels of a diagonal have their neighbours on the two before it.
    for diagonal in range(height + width - 1):
        y = np.arange(max(0, diagonal - width + 1), min(diagonal, height - 1) + 1)
        x = diagonal - y
        has_left, has_above = (x > 0)[:, None], (y > 0)[:, None]
        above = np.where(has_above, known[y - 1, x], 0)
        left = np.where(has_left, known[y, x - 1], above)
        above = np.where(has_above, above, left)
        corner = np.where(has_left & has_above, known[y - 1, x - 1], above)
        guess = np.clip(left + above - corner, np.minimum(left, above), np.maximum(left, above))
        left_over[y, x] = np.where(counts[y, x, None], codes[y, x] - guess, 0)
        known[y, x] = guess + left_over[y, x]
    return left_over


def zigzag(values: Int32[np.ndarray, "*shape"]) -> np.ndarray:
    """0, -1, 1, -2, 2, ... as 0, 1, 2, 3, 4, ...: (*shape,) int32, the high bytes of little numbers are 0."""
    return np.where(values < 0, -2 * values - 1, 2 * values).astype(np.int32)
