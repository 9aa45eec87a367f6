"""Pictures of the results of a fit's stages."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from datagen.data.images import to_8bit

if TYPE_CHECKING:
    from datagen.trace.peel import Peeler

Image8 = UInt8[np.ndarray, "h w 3"]

ENLARGED = 3
"""Width and height of a pixel in these pictures."""

SHOWN_VIEWS = 4

MARGIN = 6
"""Pixels around an object."""

AMPLIFIED = 4
"""Factor on differences."""

GAP = 4


def choose_views(seen: Bool[np.ndarray, "view h w"]) -> list[int]:
    """Chooses views to show, spread evenly over those that see the object best."""
    counts = seen.sum(axis=(1, 2))
    large = np.flatnonzero(counts >= np.quantile(counts[counts > 0], 0.5))
    return [int(large[place]) for place in np.linspace(0, len(large) - 1, min(SHOWN_VIEWS, len(large))).astype(int)]


def box_around(seen: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Rows and columns of an object, with a margin."""
    rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
    (top, bottom), (left, right) = ((max(0, at[0] - MARGIN), at[-1] + 1 + MARGIN) for at in (rows, columns))
    return slice(top, bottom), slice(left, right)


def compared(truth: Image8, drawn: Float32[np.ndarray, "h w 3"]) -> list[Image8]:
    """A picture, what was drawn, and their difference, amplified."""
    difference = np.abs(drawn - truth / np.float32(255)) * AMPLIFIED
    return [truth, to_8bit(drawn), to_8bit(np.clip(difference, 0, 1))]


def outlined(picture: Image8, mask: Bool[np.ndarray, "h w"], silhouette: Bool[np.ndarray, "h w"]) -> Image8:
    """A picture with the pixels that only a mask (red) or only a mesh (green) covers, and those of both (bluish)."""
    shown = picture.astype(np.float32) * 0.6
    for pixels, color in ((mask & ~silhouette, (255, 40, 40)), (silhouette & ~mask, (40, 255, 40))):
        shown[pixels] = color
    shown[mask & silhouette] += (0, 20, 70)
    return np.clip(shown, 0, 255).astype(np.uint8)


def silhouette_of(
    peeler: "Peeler", origin: Float32[np.ndarray, "3"], directions: Float32[np.ndarray, "h w 3"]
) -> Bool[np.ndarray, "h w"]:
    """Where rays meet what is loaded."""
    hits = peeler.trace(origin, directions.reshape(-1, 3), 1)
    return (hits.shape[0] >= 0).reshape(directions.shape[:2])


def sheet(rows: list[list[Image8]]) -> Image8:
    """Pictures side by side, row by row, enlarged."""
    large = [[np.kron(image, np.ones((ENLARGED, ENLARGED, 1), np.uint8)) for image in row] for row in rows]
    heights = [max(len(image) for image in row) for row in large]
    width = max(sum(image.shape[1] + GAP for image in row) for row in large)
    canvas = np.full((sum(heights) + GAP * len(large), width, 3), 255, np.uint8)
    top = 0
    for row, height in zip(large, heights, strict=True):
        left = 0
        for image in row:
            canvas[top : top + len(image), left : left + image.shape[1]] = image
            left += image.shape[1] + GAP
        top += height + GAP
    return canvas
