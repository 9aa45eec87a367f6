"""Finds facets and ribs around part of an outside, from masks."""

import dataclasses
from operator import attrgetter
from typing import TypeGuard

import numpy as np
from jaxtyping import Bool

from model.fit.handles import Handled
from model.fit.lathe import evenly
from model.fit.search import Cell, find_number, in_even_views, reach_of
from model.fit.shapes import Glass, Revolution
from model.fit.silhouettes import contradictions
from model.fit.views import NearRays

COUNTS = range(5, 21)
"""Facets that are tried; more would have too few columns of a mesh each."""

RIBS = -0.03
"""First guess of the depth of ribs. Masks show only their tops, and do not tell flutes from flat facets."""

TURNS = 4
"""Directions that are tried of each cut."""

LOW, HIGH = 0.1, 0.7
"""First guesses of a cut's ends, in parts of the height."""

GUESS_RAYS = 10_000
"""Rays by which first guesses are compared."""

GUESS_POINTS = 80
"""Points of the outlines that are compared; more would only cost time."""

CHOSEN = (8, 3, 1)
"""Cuts whose numbers are searched in each round."""

CUT_NUMBERS = ("cut_count", "cut_turn", "cut_depth", "cut_low", "cut_high")

_LOSS = attrgetter("loss")


def may_be_cut(glass: Glass) -> TypeGuard[Revolution]:
    """Whether it may have facets: a round glass that is open, or flat, at the top."""
    if not isinstance(glass, Revolution) or isinstance(glass, Handled):
        return False
    return glass.section is None and not glass.is_closed


def cut_in_masks(glass: Revolution, rays: NearRays) -> Revolution:
    """The glass with the cut that masks contradict least.

    Drawn pictures tell facets from each other far worse: they did not find eight flat ones, which masks find at once.
    """
    edge = rays.at_edges()
    few = edge.thinned(GUESS_RAYS)
    coarse = dataclasses.replace(glass, solid=evenly(glass.outline(), GUESS_POINTS))
    guesses = [_first_guesses(coarse, count, depth) for count in COUNTS for depth in (RIBS, _flat(count))]
    best = [min((_judged(cut, few) for cut in turned), key=_LOSS) for turned in guesses]
    for number, kept in enumerate(CHOSEN):
        best = [_searched(cut.glass, edge, number) for cut in sorted(best, key=_LOSS)[:kept]]
    numbers = {name: getattr(best[0].glass, name) for name in CUT_NUMBERS}
    return dataclasses.replace(glass, **numbers)


def _flat(count: int) -> float:
    """Depth of flat facets."""
    return float(1 / np.cos(np.pi / count) - 1)


def _first_guesses(glass: Revolution, count: int, depth: float) -> list[Revolution]:
    """The same cut, turned."""
    low, high = LOW * glass.height, HIGH * glass.height
    cut = dataclasses.replace(glass, cut_count=count, cut_depth=depth, cut_low=low, cut_high=high)
    return [dataclasses.replace(cut, cut_turn=turn / TURNS) for turn in range(TURNS)]


def _searched(cut: Glass, edge: NearRays, number: int) -> Cell:
    """With the numbers of its cut searched once."""
    is_even = in_even_views(edge.view)
    for name in CUT_NUMBERS[1:]:
        cut, _ = find_number(cut, name, reach_of(name, number), lambda glass: _misses(glass, edge), is_even)
    return _judged(cut, edge)


def _judged(cut: Glass, edge: NearRays) -> Cell:
    return Cell(glass=cut, loss=float(_misses(cut, edge).mean()))


def _misses(cut: Glass, edge: NearRays) -> Bool[np.ndarray, "edge 3"]:
    return np.repeat(contradictions(cut.mesh(), edge)[:, None], 3, axis=1)
