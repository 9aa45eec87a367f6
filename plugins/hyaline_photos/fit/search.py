"""Finds the numbers of a glass by drawing it: a grid first, then one number after the other.

The loss is rugged: derivatives of sharp pixels do not point to the truth, whereas the best of a few values does. Only
the index is found better by a parabola over a wide bracket.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.scene.materials import as_vector
from datagen.terminal.command import track
from hyaline_photos.fit.materials import (
    INDICES,
    LEAST_ROUGHNESS,
    STEPS,
    Found,
    Misses,
    best_of,
    curve_of,
    find_absorption,
    find_material,
    smoothed,
    vertex,
)
from hyaline_photos.fit.shapes import USUAL_WALL, Glass, Revolution

SOFTNESS = 0.05
"""sRGB differences well below it count by their squares, those above by their size (Charbonnier's penalty)."""

WALLS = (0.03, 0.05, 0.08, 0.12, 0.2)
FLOORS = (0.05, 0.1, 0.15, 0.25, 0.4, 0.5, 0.6)
CORNERS = (0.15, 0.5)
"""The grid: parts of the largest radius, of the height, and of the floor's radius."""

USUAL = (USUAL_WALL, 0.15, 0.3)
"""A usual vessel: wall, floor and corner in the same units."""

LAST = 5
"""Number of the last round."""

INDEX_HELD = 2
"""Number of rounds before a vessel's index is searched: while walls are wrong, a wrong index explains pictures best."""

SHRINKS = 0.55
"""Factor by which brackets shrink from round to round."""

CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True, kw_only=True)
class Number:
    """How one number of a glass is searched."""

    low: float
    high: float
    reach: float
    """Half the first bracket: of the number's logarithm, or of the number itself if not `is_factor`."""
    least: float
    """Half the last bracket: over less, the least follows the noise."""
    is_factor: bool = True
    by_parabola: bool = False


NUMBERS: dict[str, Number] = {
    "wall": Number(low=1e-5, high=1.0, reach=0.3, least=0.12),
    "floor": Number(low=1e-5, high=10.0, reach=0.25, least=0.06),
    "corner": Number(low=0.02, high=0.95, reach=0.6, least=0.2),
    "foot": Number(low=1e-6, high=1.0, reach=1.2, least=0.3),
    "ior": Number(low=1.2, high=2.5, reach=0.08, least=0.06, is_factor=False, by_parabola=True),
    "taper": Number(low=0.4, high=2.5, reach=0.3, least=0.12),
    "roughness": Number(low=LEAST_ROUGHNESS, high=0.8, reach=0.5, least=0.25),
    "level": Number(low=1e-5, high=10.0, reach=0.06, least=0.02),
    "drink_ior": Number(low=1.2, high=2.0, reach=0.08, least=0.06, is_factor=False, by_parabola=True),
}
"""Search ranges, in search order. In metres: wall (above the floor), floor (the hollow's lowest point above the
outside's), foot (reach of the rounding between bottom and side), level (of a drink above the outside's lowest point).
Relative: taper (wall at the rim over that above the floor), corner (reach of the rounding between floor and wall, in
parts of the floor's radius)."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A glass that was tried, such as a cell of the grid."""

    glass: Glass
    loss: float


def in_even_views(view: Int[np.ndarray, " pixel"]) -> Bool[np.ndarray, " pixel"]:
    """Splits pixels into two halves by their views: every other one of those that have any, or pixels of a single view.

    Views that do not see the object must not count, or a half may be empty.
    """
    rank = np.unique(view, return_inverse=True)[1]
    return (rank if rank.any() else np.arange(len(view))) % 2 == 0


def penalty(differences: Float[np.ndarray, "*pixel 3"]) -> Float[np.ndarray, "*pixel 3"]:
    """Charbonnier's penalty of sRGB differences."""
    return np.sqrt(differences**2 + SOFTNESS**2) - SOFTNESS


def guess(
    outside: Glass, misses: Misses, is_even: Bool[np.ndarray, " pixel"], *, label: str
) -> tuple[list[Cell], Glass]:
    """Draws the grid, and chooses a material for its best cell.

    Clear glass is drawn first, which may explain tint and frost by a wrong wall. So the best cell of each wall gets a
    material of its own, and the grid is drawn again like the best of these; if that is frosted, also with a tint alone:
    a little frost makes up for a wrong wall.
    """

    def drawn(like: Glass | None) -> tuple[list[Cell], Glass]:
        cells = list(track(scan(outside, misses, like), label=label, total=len(_cells(outside))))
        return cells, find_material(alternatives(cells)[0].glass, misses, is_even)

    cells, glass = drawn(None)
    if len(cells) == 1 or not (any(glass.absorption) or "roughness" in glass.numbers):
        return cells, glass
    apart = [cell.glass for cell in _best_by_wall(cells)]
    likes = [best_of([find_absorption(each, "absorption", misses, is_even)[0] for each in apart], misses)]
    if "roughness" in glass.numbers:
        likes.insert(0, best_of([find_material(each, misses, is_even) for each in apart], misses))
    return min(map(drawn, likes), key=lambda each: float(misses(each[1]).mean()))


def _best_by_wall(cells: Sequence[Cell]) -> list[Cell]:
    """The best cell of each wall, and of solids."""
    best: dict[float | None, Cell] = {}
    for cell in sorted(cells, key=lambda cell: cell.loss):
        best.setdefault(cell.glass.numbers.get("wall"), cell)
    return list(best.values())


def scan(outside: Glass, misses: Misses, like: Glass | None = None) -> Iterator[Cell]:
    """Solid, and unless the outside is closed, vessels of every wall, floor and corner of the grid.

    Solids have several indices: beside vessels, one of 1.8 with an index of 1.5 was found hollow.

    Args:
        like: a glass whose tint and roughness they share; None: they keep those of the outside.
    """
    for glass in _cells(outside):
        shaded = glass if like is None else _as_dark_as(glass, like)
        yield Cell(glass=shaded, loss=float(misses(shaded).mean()))


def guesses(outside: Glass) -> tuple[Glass, ...]:
    """The outside as solid glass, and as a usual vessel where it may be one."""
    if not isinstance(outside, Revolution) or outside.is_closed:
        return (outside,)
    return _cells(outside)[0] if outside.hollow else outside, outside.hollowed(*USUAL)


def _as_dark_as(glass: Glass, other: Glass) -> Glass:
    """With the roughness of another glass, and its tint so that as much light gets through walls of this thickness."""
    absorption = np.array(other.absorption) * (_thickness(other) / _thickness(glass))
    frost = {name: value for name, value in other.numbers.items() if name == "roughness"}
    return dataclasses.replace(glass.without("roughness").having(**frost), absorption=as_vector(absorption))


def _thickness(glass: Glass) -> float:
    """Thickness of a vessel's wall, or half the width of a solid; 1 for shapes that are always solid."""
    if not isinstance(glass, Revolution):
        return 1.0
    return glass.hollow[0] if glass.hollow else float(glass.outside[:, 0].max())


def _cells(outside: Glass) -> list[Glass]:
    if not isinstance(outside, Revolution) or outside.is_closed:
        return [outside]
    solids: list[Glass] = [outside.having(ior=ior) for ior in INDICES]
    vessels: list[Glass] = [outside.hollowed(*cell) for cell in itertools.product(WALLS, FLOORS, CORNERS)]
    return vessels if outside.hollow else [*solids, *vessels]  # What holds a drink is a vessel.


def refine(
    glass: Glass, misses: Misses, is_even: Bool[np.ndarray, " pixel"], *, number: int
) -> Iterator[tuple[Glass, str, Found]]:
    """Searches each number in turn, once.

    Args:
        is_even: see `in_even_views`.
        number: of the round; brackets narrow from round to round.

    Yields:
        The glass after each search, the name of the number, and what was found.
    """
    if "roughness" in glass.numbers:
        glass = smoothed(glass, misses)
    for name in _absorptions(glass):
        glass, channels = find_absorption(glass, name, misses, is_even)
        for channel, found in zip(CHANNELS, channels, strict=True):
            yield glass, f"{name}_{channel}", found
    for name in _searched(glass, number):
        glass, found = find_number(glass, name, reach_of(name, number), misses, is_even)
        yield glass, name, found


def count_searches(glass: Glass, number: int) -> int:
    """How much `refine` yields in a round."""
    return len(CHANNELS) * len(_absorptions(glass)) + len(_searched(glass, number))


def _absorptions(glass: Glass) -> tuple[str, ...]:
    return ("absorption",) if "drink_ior" not in glass.numbers else ("absorption", "drink_absorption")


def _searched(glass: Glass, number: int) -> list[str]:
    held = {"ior"} if number < INDEX_HELD and glass.hollow else set()
    return [name for name in NUMBERS if name in glass.numbers and name not in held]


def reach_of(name: str, number: int) -> float:
    """Half the bracket of a number in a round."""
    return max(NUMBERS[name].reach * SHRINKS**number, NUMBERS[name].least)


def find_number(
    glass: Glass, name: str, reach: float, misses: Misses, is_even: Bool[np.ndarray, " pixel"]
) -> tuple[Glass, Found]:
    """Searches one of `NUMBERS` in a bracket of half this width."""
    how = NUMBERS[name]
    steps = reach * np.linspace(-1, 1, STEPS)
    now = glass.numbers[name]
    values = np.clip(now * np.exp(steps) if how.is_factor else now + steps, how.low, how.high)
    losses = np.stack([misses(glass.having(**{name: float(value)})).mean(axis=1) for value in values])
    places = np.log(values) if how.is_factor else values

    def lowest(pixels: Bool[np.ndarray, " pixel"] | slice, *, by_parabola: bool) -> float:
        means = losses[:, pixels].mean(axis=1)
        place = vertex(places, means) if by_parabola else float(places[means.argmin()])
        return float(np.exp(place)) if how.is_factor else place

    value = lowest(slice(None), by_parabola=how.by_parabola)
    halves = (lowest(is_even, by_parabola=True), lowest(~is_even, by_parabola=True))
    found = Found(value=value, even=halves[0], odd=halves[1], curve=curve_of(values, losses.mean(axis=1)))
    return glass.having(**{name: value}), found


def alternatives(cells: Sequence[Cell]) -> tuple[Cell, Cell]:
    """The best cell and the second best: the best of those with another wall or floor."""
    ordered = sorted(cells, key=lambda cell: cell.loss)
    others = [cell for cell in ordered[1:] if cell.glass.hollow != ordered[0].glass.hollow]
    return ordered[0], (others or ordered)[0]
