"""Finds facets, flutes and ribs around part of an outside by drawing them, since masks hardly show them."""

import dataclasses
from collections.abc import Callable
from operator import attrgetter

import numpy as np
from jaxtyping import Bool

from datagen.terminal.command import say
from model.fit.handles import Handled
from model.fit.search import NUMBERS, Cell, Misses, find_number
from model.fit.shapes import Glass, Revolution

CUT_ROUND = 0
"""Number of the round of a search after which cuts are tried: the wall is roughly known."""

BADLY_DRAWN = 0.025
"""Mean penalty above which a glass may be cut."""

WORTH_A_CUT = 0.1
"""Share of the penalty that a cut has to take away: many shallow facets blur, which hides other errors."""

WRONG_EDGES = 0.01
"""Share of the pixels at a mask's edge that a cut may get wrong in addition; right flutes had 0.004."""

COUNTS = range(5, 21)
"""Facets that are tried; more would have too few columns of a mesh each."""

RIBS, FLUTES = -0.06, 0.06
"""First guesses of the depth: of ribs, and of flutes beyond that of flat facets."""

TURNS = 4
"""Directions that are tried of each cut."""

LOW, HIGH = 0.1, 0.7
"""First guesses of a cut's ends, in parts of the height."""

CHOSEN = 5
"""Counts whose numbers are searched; the best of these wins."""

_LOSS = attrgetter("loss")


def with_cut(
    glass: Glass, misses: Misses, is_even: Bool[np.ndarray, " pixel"], wrong: Callable[[Glass], float]
) -> Glass:
    """A badly drawn glass of revolution with the facets that explain pictures best, if these explain enough.

    Args:
        wrong: share of the pixels at a mask's edge that a glass gets wrong.
    """
    if not isinstance(glass, Revolution) or isinstance(glass, Handled) or glass.section or glass.is_closed:
        return glass
    uncut = _drawn(glass, misses)
    if uncut.loss < BADLY_DRAWN:
        return glass
    say("  trying facets, since the glass is drawn badly")
    smooth = dataclasses.replace(glass, roughness=None)
    best = [min((_drawn(cut, misses) for cut in _first_guesses(smooth, count)), key=_LOSS) for count in COUNTS]
    settled = [_drawn(_settled(cut.glass, misses, is_even), misses) for cut in sorted(best, key=_LOSS)[:CHOSEN]]
    most_wrong = wrong(glass) + WRONG_EDGES
    found = min((cut for cut in settled if wrong(cut.glass) < most_wrong), key=_LOSS, default=uncut)
    return found.glass if found.loss < (1 - WORTH_A_CUT) * uncut.loss else glass


def _first_guesses(glass: Revolution, count: int) -> list[Revolution]:
    flat = float(1 / np.cos(np.pi / count) - 1)
    return [
        dataclasses.replace(
            glass,
            cut_count=count,
            cut_depth=depth,
            cut_turn=turn / TURNS,
            cut_low=LOW * glass.height,
            cut_high=HIGH * glass.height,
        )
        for depth in (RIBS, flat, flat + FLUTES)
        for turn in range(TURNS)
    ]


def _settled(cut: Glass, misses: Misses, is_even: Bool[np.ndarray, " pixel"]) -> Glass:
    for name in NUMBERS:
        if name.startswith("cut_"):
            cut, _ = find_number(cut, name, NUMBERS[name].reach, misses, is_even)
    return cut


def _drawn(glass: Glass, misses: Misses) -> Cell:
    return Cell(glass=glass, loss=float(misses(glass).mean()))
