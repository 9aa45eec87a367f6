"""Finds the numbers and materials of a glass by drawing it: a grid first, then one number after the other.

The loss is rugged: derivatives of sharp pixels do not point to the truth, whereas the best of a few values does. Only
the index is found better by a parabola over a wide bracket.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.scene.materials import as_vector
from datagen.terminal.command import track
from hyaline_photos.fit.shapes import USUAL_WALL, WATER, Glass, Revolution

STEPS = 7
"""Values that are tried of a number that was found before."""
ABSORPTIONS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
"""1/m."""
TINT_REACH = 0.6
"""Half the bracket of the logarithm of an absorption that was found before."""
WORTH_IT = 0.02
"""Share of the penalty of clear, smooth glass that tint or frost has to take away; a tint, of a channel's."""
AS_BLACK = 0.001
"""Share of a channel's penalty within which tints count as equal. Beyond some tint no light gets through, and noise
alone would darken a drink from round to round."""
ROUGHNESSES = (0.03, 0.06, 0.12, 0.25)
"""GGX alpha."""
LEAST_ROUGHNESS = 0.005
INDICES = (1.33, 1.4, 1.45, 1.5, 1.55, 1.6, 1.65, 1.7, 1.75, 1.8, 1.9, 2.0, 2.2, 2.4)
"""First guesses for solid glass; the search then moves by less than 0.1 in each round."""
USUAL_INDEX = 1.5
AS_USUAL = 0.01
"""Share of the least loss by which a more usual index of frosted glass may explain less."""

Misses = Callable[[Glass], Float[np.ndarray, "pixel 3"]]
"""Loss of an object's pixels, by colour channel, as a function of the glass that replaces it."""
SOFTNESS = 0.05
"""sRGB differences well below it count by their squares, those above by their size (Charbonnier's penalty)."""
WALLS = (0.03, 0.05, 0.08, 0.12, 0.2)
FLOORS = (0.05, 0.1, 0.15, 0.25, 0.4, 0.5, 0.6)
CORNERS = (0.15, 0.5)
"""The grid: parts of the largest radius, of the height, and of the floor's radius."""
WORTH_A_DRINK = 0.2
"""Share of the loss that a drink which masks do not show has to take away. For a vessel by Cycles it was 45 %."""
LEAST_GLASS = 1.42
"""Index below that of all solid glass: fluorite has 1.43."""
FILLED_WALLS, FILLED_CORNER, LEVELS = (0.05, 0.12), 0.3, (0.3, 0.6, 0.8, 0.95)
"""The same of vessels that hold a drink, whose walls bend light little; levels in parts of the hollow's height."""
USUAL = (USUAL_WALL, 0.15, 0.3)
"""A usual vessel: wall, floor and corner in the same units."""
LAST = 4
"""Number of the last round."""
FAR = tuple(np.exp(np.linspace(-0.7, 0.7, 8)).tolist())
"""Factors on walls and floors, which are tried in the last round to see how far away others explain as well."""
INDEX_HELD = 2
"""Number of rounds before a vessel's index is searched: while walls are wrong, a wrong index explains pictures best."""
SHRINKS = 0.55
"""Factor by which brackets shrink from round to round."""
CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True, kw_only=True)
class Found:
    """One number of a glass."""

    value: float
    even: float
    """Estimate from the even views alone."""
    odd: float
    before: float | None = None
    """The value that the round before found; in the last stage, with other textures."""
    curve: tuple[tuple[float, float], ...] = ()
    """The values that were tried, each with its mean penalty."""
    as_good: tuple[float, ...] = ()
    """Values far away that explain pictures as well if others change, too."""


def find_material(glass: Glass, misses: Misses, is_even: Bool[np.ndarray, " pixel"]) -> Glass:
    """First guesses of tint, index and roughness. Tint and index of a solid are found in turns."""
    glass, _ = find_absorption(glass, "absorption", misses, is_even)
    found = find_index(glass, misses)
    if found.numbers != glass.numbers:
        found, _ = find_absorption(found, "absorption", misses, is_even)
    return find_roughness(found, misses)


def find_index(glass: Glass, misses: Misses) -> Glass:
    """The best of the first guesses of its index; a vessel keeps the one it has.

    As long as a wall is only roughly known, another index makes up for its errors: the wall of a bottle of index 1.52
    was found a fifth too thin, with an index of 1.94.
    """
    return glass if glass.hollow else best_of([glass.having(ior=value) for value in INDICES], misses)


def find_roughness(glass: Glass, misses: Misses) -> Glass:
    """Frosted, if that explains more than smooth glass does: a little of it hides other errors.

    Frosted solids get another index, too. Less frost with a higher index spreads light just as far, so many pairs
    explain pictures as well, and of these the most usual index is taken.
    """
    tried = [glass.having(roughness=value) for value in ROUGHNESSES]
    found = smoothed(best_of(tried, misses), misses)
    if "roughness" not in found.numbers or found.hollow:
        return found
    pairs = itertools.product(INDICES, ROUGHNESSES)
    cells = list(scan([glass.having(ior=ior, roughness=roughness) for ior, roughness in pairs], misses))
    as_good = [cell for cell in cells if cell[1] <= (1 + AS_USUAL) * min(loss for _, loss in cells)]
    return min(as_good, key=lambda cell: (abs(cell[0].numbers["ior"] - USUAL_INDEX), cell[1]))[0]


def smoothed(frosted: Glass, misses: Misses) -> Glass:
    """Smooth, unless frost explains more than hardly any, which is drawn by as many rays."""
    hardly = frosted.having(roughness=LEAST_ROUGHNESS)
    is_worth_it = misses(frosted).mean() < (1 - WORTH_IT) * misses(hardly).mean()
    return frosted if is_worth_it else frosted.without("roughness")


def best_of(glasses: Sequence[Glass], misses: Misses) -> Glass:
    """The glass with the least loss."""
    return min(glasses, key=lambda each: float(misses(each).mean()))


def find_absorption(
    glass: Glass, name: str, misses: Misses, is_even: Bool[np.ndarray, " pixel"]
) -> tuple[Glass, tuple[Found, ...]]:
    """Searches the absorption of all colour channels at once: each is judged by its own channel of the pictures.

    Args:
        name: `absorption`, or `drink_absorption` of what a vessel holds.
    """
    now = np.array(getattr(glass, name))
    tried = ABSORPTIONS if not now.any() else (0.0, *np.exp(np.linspace(-TINT_REACH, TINT_REACH, STEPS)))
    values = np.array(tried)[:, None] * (1 if not now.any() else np.where(now > 0, now, now.max()))
    values = np.broadcast_to(values, (len(tried), 3))
    drawn = [misses(dataclasses.replace(glass, **{name: as_vector(row)})) for row in values]

    def lowest(pixels: Bool[np.ndarray, " pixel"] | slice) -> Float[np.ndarray, "3"]:
        means = np.stack([miss[pixels].mean(axis=0) for miss in drawn])
        return np.array([_lowest_positive(*each) for each in zip(values.T, means.T, strict=True)])

    losses = np.stack([miss.mean(axis=0) for miss in drawn])
    estimates = np.stack([lowest(slice(None)), lowest(is_even), lowest(~is_even)])
    # Clear glass is drawn first: a little absorption hides other errors.
    if not (losses.min(axis=0) < (1 - WORTH_IT) * losses[0]).any():
        estimates = np.zeros((3, 3))
    channels = zip(estimates.T.tolist(), values.T, losses.T, strict=True)
    found = tuple(
        Found(value=v, even=e, odd=o, curve=tuple(zip(tried.tolist(), each.tolist())))
        for (v, e, o), tried, each in channels
    )
    return dataclasses.replace(glass, **{name: as_vector(estimates[0])}), found


def _lowest_positive(values: Float[np.ndarray, " value"], losses: Float[np.ndarray, " value"]) -> float:
    """0 where that is best; else where a parabola through the least of the losses and its neighbours is lowest.

    If the last value is best, the first that is as good replaces it.
    """
    place = int(losses.argmin())
    if place == len(losses) - 1:
        place = int(np.argmax(losses <= (1 + AS_BLACK) * losses[place]))
    if place == 0:
        return 0.0
    near = slice(max(place - 1, 1), place + 2)
    return float(np.exp(vertex(np.log(values[near]), losses[near]))) if place > 1 else float(values[place])


def vertex(places: Float[np.ndarray, " value"], losses: Float[np.ndarray, " value"]) -> float:
    """Where a parabola through losses is lowest, within the bracket; the place of the least where it is not convex."""
    if len(np.unique(places)) < 3:
        return float(places[losses.argmin()])
    a, b, _ = np.polyfit(places - places.mean(), losses, 2)
    if a <= 0:
        return float(places[losses.argmin()])
    return float(np.clip(places.mean() - b / (2 * a), places.min(), places.max()))


# The grid, and rounds


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
    outside: Glass, misses: Misses, is_even: Bool[np.ndarray, " pixel"], *, label: str, may_be_filled: bool = False
) -> Glass:
    """Draws the grid, and chooses a material for its best cell.

    Clear glass is drawn first, which may explain tint and frost by a wrong wall. So the best cell of each wall gets a
    material of its own, and the grid is drawn again like the best of these; if that is frosted, also with a tint alone:
    a little frost makes up for a wrong wall.

    Args:
        may_be_filled: it may hold a drink that masks do not tell from it.
    """
    asked = cells_of(outside, may_be_filled=may_be_filled)

    def drawn(like: Glass | None) -> list[tuple[Glass, float]]:
        cells = track(scan(asked, misses, like), label=label, total=len(asked))
        return sorted(cells, key=lambda cell: cell[1])

    found = drawn(None)
    dry, filled = ([cell for cell in found if ("level" in cell[0].numbers) == holds] for holds in (False, True))
    if dry and filled:
        # Both are searched first: levels of the grid are far apart, and little else in a picture is as sharp.
        empty, full = ([*refine(cells[0][0], misses, is_even, number=0)][-1][0] for cells in (dry, filled))
        if misses(full).mean() > (1 - WORTH_A_DRINK) * misses(empty).mean():
            found, asked = dry, [glass for glass in asked if "level" not in glass.numbers]
    cells = [glass for glass, _ in found]
    glass = find_material(cells[0], misses, is_even)
    if len(cells) == 1 or not (any(glass.absorption) or "roughness" in glass.numbers):
        return glass
    # The best cell of each wall, and of solids.
    apart = {cell.numbers.get("wall"): cell for cell in reversed(cells)}.values()
    likes = [best_of([find_absorption(each, "absorption", misses, is_even)[0] for each in apart], misses)]
    if "roughness" in glass.numbers:
        likes.insert(0, best_of([find_material(each, misses, is_even) for each in apart], misses))
    return best_of([find_material(drawn(like)[0][0], misses, is_even) for like in likes], misses)


def scan(cells: Sequence[Glass], misses: Misses, like: Glass | None = None) -> Iterator[tuple[Glass, float]]:
    """Cells of the grid with their losses.

    Args:
        like: a glass whose tint and roughness they share; None: they keep their own.
    """
    for glass in cells:
        shaded = glass if like is None else _as_dark_as(glass, like)
        yield shaded, float(misses(shaded).mean())


def guesses(outside: Glass) -> tuple[Glass, ...]:
    """The outside as solid glass, and as a usual vessel where it may be one."""
    if not isinstance(outside, Revolution) or outside.is_closed:
        return (outside,)
    return cells_of(outside)[0] if outside.hollow else outside, outside.hollowed(*USUAL)


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


def cells_of(outside: Glass, *, may_be_filled: bool = False) -> list[Glass]:
    """Solid, and unless the outside is closed, vessels of every wall, floor and corner of the grid.

    Solids have several indices: beside vessels, one of 1.8 with an index of 1.5 was found hollow. What may be filled is
    no solid of water's index: a full shot glass on a third of its photographs was found as one.
    """
    if not isinstance(outside, Revolution) or outside.is_closed:
        return [outside]
    solids: list[Glass] = [outside.having(ior=ior) for ior in INDICES if ior > LEAST_GLASS or not may_be_filled]
    vessels: list[Glass] = [outside.hollowed(*cell) for cell in itertools.product(WALLS, FLOORS, CORNERS)]
    if "level" in outside.numbers:  # What holds a drink is a vessel.
        return vessels
    filled: list[Glass] = []
    for wall, floor, level in itertools.product(FILLED_WALLS, FLOORS, LEVELS if may_be_filled else ()):
        height = outside.height * (floor + level * (1 - floor))
        filled.append(outside.hollowed(wall, floor, FILLED_CORNER).having(level=height, drink_ior=WATER))
    return [*solids, *vessels, *filled]


def refine(
    glass: Glass, misses: Misses, is_even: Bool[np.ndarray, " pixel"], *, number: int
) -> Iterator[tuple[Glass, str, Found]]:
    """Searches each number in turn, once.

    Args:
        is_even: see `in_even_views`.
        number: of the round; brackets narrow from round to round.

    Yields:
        The glass after the search, the name of the number, and what was found.
    """
    if "roughness" in glass.numbers:
        glass = smoothed(glass, misses)
    for name in ("absorption", "drink_absorption") if "drink_ior" in glass.numbers else ("absorption",):
        glass, channels = find_absorption(glass, name, misses, is_even)
        for channel, found in zip(CHANNELS, channels, strict=True):
            yield glass, f"{name}_{channel}", found
    held = {"ior"} if number < INDEX_HELD and glass.hollow else set()
    numbers: dict[str, Found] = {}
    for name in [name for name in NUMBERS if name in glass.numbers and name not in held]:
        glass, numbers[name] = find_number(glass, name, reach_of(name, number), misses, is_even)
    if number == LAST and glass.hollow:
        numbers |= far_away(glass, numbers, misses)
    for name, found in numbers.items():
        yield glass, name, found


def far_away(glass: Glass, found: Mapping[str, Found], misses: Misses) -> dict[str, Found]:
    """Adds walls and floors far from those of a vessel that explain pictures as well: a lower floor may need another
    corner, and a thicker wall has to stay as thick at the rim, which pictures show."""
    now, added = glass.numbers, {}
    walls = [{"wall": now["wall"] * factor, "taper": now["taper"] / factor} for factor in FAR]
    floors = [{"floor": now["floor"] * factor, "corner": each} for factor, each in itertools.product(FAR, CORNERS)]
    for tried in (walls, floors):
        losses = [loss for _, loss in scan([glass, *(glass.having(**each) for each in tried)], misses)]
        as_good = [each for each, loss in zip(tried, losses[1:], strict=True) if loss <= (1 + WORTH_IT) * min(losses)]
        for name in tried[0]:
            added[name] = dataclasses.replace(found[name], as_good=tuple(each[name] for each in as_good))
    return added


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
    even, odd = (lowest(half, by_parabola=True) for half in (is_even, ~is_even))
    curve = tuple(zip(values.tolist(), losses.mean(axis=1).tolist()))
    return glass.having(**{name: value}), Found(value=value, even=even, odd=odd, curve=curve)
