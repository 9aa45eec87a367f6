"""Intervals for the numbers of a glass; docs/notes/fitting.md reports how often they contain the truth."""

from collections.abc import Mapping

import numpy as np

from hyaline_photos.fit.materials import ABSORPTIONS, STEPS, TINT_REACH, WORTH_IT, Found
from hyaline_photos.fit.search import LAST, NUMBERS, reach_of

WALL_ERROR, FLOOR_ERROR = 0.07, 0.75
"""In pixels at the object's distance. Masks show an outside to such a share of a pixel, and a hollow is found from
there; a floor is seen at a slant, through the wall."""

NORMALS_ERROR = 0.03
"""GGX alpha of smooth glass whose normals are 1 to 2 degrees off."""

FROSTED_INDEX_ERROR = 0.1
"""Of the index of frosted solids: less frost with a higher index spreads light as far."""

WELL = 0.02
"""Mean penalty of the pixels of glass whose shape is right. More of it means that the shape is wrong, and biases all
numbers."""


def intervals(numbers: Mapping[str, Found], pixel: float) -> dict[str, tuple[float, float]]:
    """The intervals of all numbers of a glass, or of its drink.

    The refraction of a thin wall is proportional to (n - 1) / n times its thickness, so that a vessel's index n is as
    uncertain as its wall: an index that is n (n - 1) p too high makes up for a wall that is a share p too thin.

    Args:
        pixel: width in metres of a pixel at the object's distance.
    """
    least = {"wall": WALL_ERROR * pixel, "floor": FLOOR_ERROR * pixel, "roughness": NORMALS_ERROR}
    if "roughness" in numbers and "wall" not in numbers:
        least["ior"] = FROSTED_INDEX_ERROR
    found = {name: _interval(name, number, least.get(name, 0.0)) for name, number in numbers.items()}
    if "wall" in found and "ior" in found:
        index, wall = numbers["ior"].value, numbers["wall"].value
        reach = index * (index - 1) * max(abs(end - wall) for end in found["wall"]) / wall
        low, high = found["ior"]
        found["ior"] = min(low, index - reach), max(high, index + reach)
    return found


def _interval(name: str, found: Found, least: float) -> tuple[float, float]:
    """On either side as far as the two halves of the views differ, as the last round moved the number, and as the
    values that were tried last lie apart, all the wider the worse pictures are explained; and as far as values explain
    them as well."""
    spread = max(abs(found.even - found.odd), _last_step(name, found.value), least)
    if found.before is not None:
        spread = max(spread, abs(found.value - found.before))
    ends = [found.value]
    if found.curve:
        values, losses = np.array(sorted(found.curve)).T
        spread *= max(1.0, losses.min() / WELL)
        fine = np.linspace(values[0], values[-1], 1001)
        as_good = fine[np.interp(fine, values, losses) <= (1 + WORTH_IT) * losses.min()]
        ends += [float(as_good[0]), float(as_good[-1])]
    lowest = min(NUMBERS[name].low, 0.0) if name in NUMBERS else 0.0
    return max(min(found.value - spread, *ends), lowest), max(found.value + spread, *ends)


def _last_step(name: str, value: float) -> float:
    """Distance between the values that were tried last."""
    if "absorption" in name:
        return max(TINT_REACH * 2 / (STEPS - 1) * value, ABSORPTIONS[1])
    step = 2 * reach_of(name, LAST) / (STEPS - 1)
    return step * value if NUMBERS[name].is_factor else step
