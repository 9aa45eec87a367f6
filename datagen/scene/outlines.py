"""Outlines of the area where an image's values, interpolated bilinearly, reach a level: loops of points.

Places are in texels: the centre of texel (row r, column c) of a grid is at (c, r).
"""

import numpy as np
from jaxtyping import Bool, Float, Int64

Grid = Float[np.ndarray, "row column"]
Loops = list[Float[np.ndarray, "point 2"]]

CORNERS = np.array([[0, 0], [0, 1], [1, 1], [1, 0]])
"""Of a cell, as (row, column) from its first one: once around, so that its sides go from each to the next."""


def count_crossings(values: Grid, level: float) -> int:
    """The number of points that the outlines have."""
    above = values >= level
    return int((above[1:] != above[:-1]).sum() + (above[:, 1:] != above[:, :-1]).sum())


def outlines(values: Grid, level: float) -> Loops:
    """Closed loops around all that is at least `level`, which lies on their left; x is the column, y the row.

    The grid's border must be below the level, so that every loop closes. Between two texels whose values lie on either
    side of the level, a loop passes where their interpolation reaches it; inside a cell of four texels it is straight.
    """
    start, end = _segments(values, level)
    if not len(start):
        return []
    order = np.argsort(start)
    following = order[np.searchsorted(start, end, sorter=order)]  # Each crossing ends one segment and starts one.
    places = _places(values, level, start)
    loops, is_left = [], np.ones(len(start), bool)
    for first in range(len(start)):
        if not is_left[first]:
            continue
        walk, at = [], first
        while is_left[at]:
            is_left[at] = False
            walk.append(at)
            at = following[at]
        loops.append(places[walk])
    return loops


def _segments(values: Grid, level: float) -> tuple[Int64[np.ndarray, " segment"], Int64[np.ndarray, " segment"]]:
    """The crossings at which the segments of all cells start and end, as numbers of the grid's sides."""
    height, width = values.shape
    heights, widths = height - 1, width - 1
    corners = [values[r : r + heights, c : c + widths] - level for r, c in CORNERS]
    above = [corner >= 0 for corner in corners]
    joined = _is_joined(corners)
    row, column = np.mgrid[:heights, :widths]
    # Sides along rows come first, then those along columns.
    along = row * width + column
    across = height * width + along
    sides = [along, across + 1, along + width, across]
    starts, ends = [], []
    for side in range(4):
        leaves = above[side] & ~above[(side + 1) % 4]
        for steps in (1, 2, 3):
            other = (side + steps) % 4
            enters = ~above[other] & above[(other + 1) % 4]
            # Of a cell's two segments, those that join its corners lead to the next side, others to the one before.
            is_chosen = leaves & enters & _is_chosen(above, steps, joined)
            starts.append(sides[side][is_chosen])
            ends.append(sides[other][is_chosen])
    return np.concatenate(starts), np.concatenate(ends)


def _is_joined(corners: list[Grid]) -> Bool[np.ndarray, "cell_row cell_column"]:
    """Where opposite corners are above the level, and their area goes through the middle of the cell."""
    a, b, c, d = corners
    # The value at the saddle of the bilinear surface; its sign is that of the numerator times the denominator's.
    return (a * c - b * d) * (a + c - b - d) > 0


def _is_chosen(above: list[np.ndarray], steps: int, joined: np.ndarray) -> np.ndarray:
    is_saddle = (above[0] == above[2]) & (above[1] == above[3]) & (above[0] != above[1])
    if steps == 2:
        return ~is_saddle
    return ~is_saddle | (joined if steps == 1 else ~joined)


def _places(values: Grid, level: float, crossing: Int64[np.ndarray, " crossing"]) -> Float[np.ndarray, "crossing 2"]:
    """Where on their sides the crossings are."""
    height, width = values.shape
    is_across = crossing >= height * width
    row, column = np.divmod(crossing - is_across * height * width, width)
    from_level = values[row, column] - level
    other = values[row + is_across, column + ~is_across] - level
    share = from_level / (from_level - other)
    return np.stack([column + share * ~is_across, row + share * is_across], axis=-1)
