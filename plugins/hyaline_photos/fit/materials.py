"""First guesses of a glass's material: its tint, its index and its frost, by drawing it."""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from datagen.scene.materials import as_vector
from hyaline_photos.fit.shapes import Glass

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

    Frosted solids get another index, too. Less frost with a higher index spreads light as far, so many pairs explain
    pictures as well, and of these the most usual index is taken.
    """
    tried = [glass.having(roughness=value) for value in ROUGHNESSES]
    found = smoothed(best_of(tried, misses), misses)
    if "roughness" not in found.numbers or found.hollow:
        return found
    pairs = itertools.product(INDICES, ROUGHNESSES)
    tried = [glass.having(ior=ior, roughness=roughness) for ior, roughness in pairs]
    losses = [float(misses(each).mean()) for each in tried]
    as_good = [(each, loss) for each, loss in zip(tried, losses, strict=True) if loss <= (1 + AS_USUAL) * min(losses)]
    return min(as_good, key=lambda each: (abs(each[0].numbers["ior"] - USUAL_INDEX), each[1]))[0]


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
) -> tuple[Glass, tuple[Found, Found, Found]]:
    """Searches the absorption of all colour channels at once: each is judged by its own channel of the pictures.

    Args:
        name: `absorption`, or `drink_absorption` of what a vessel holds.
    """
    now = np.array(getattr(glass, name))
    tried = ABSORPTIONS if not now.any() else (0.0, *np.exp(np.linspace(-TINT_REACH, TINT_REACH, STEPS)))
    values = np.array(tried)[:, None] * (1 if not now.any() else np.where(now > 0, now, now.max()))
    values = np.broadcast_to(values, (len(tried), 3))
    drawn = [misses(dataclasses.replace(glass, **{name: as_vector(row)})) for row in values]

    def means(pixels: Bool[np.ndarray, " pixel"] | slice) -> Float[np.ndarray, "value 3"]:
        return np.stack([miss[pixels].mean(axis=0) for miss in drawn])

    def lowest(pixels: Bool[np.ndarray, " pixel"] | slice) -> Float[np.ndarray, "3"]:
        return np.array([_lowest_positive(*each) for each in zip(values.T, means(pixels).T, strict=True)])

    best, even, odd = lowest(slice(None)), lowest(is_even), lowest(~is_even)
    if not _explains_more(drawn):
        best = even = odd = np.zeros(3)
    curves = map(curve_of, values.T, means(slice(None)).T)
    found = [
        Found(value=float(v), even=float(e), odd=float(o), curve=curve)
        for v, e, o, curve in zip(best, even, odd, curves, strict=True)
    ]
    return dataclasses.replace(glass, **{name: as_vector(best)}), (found[0], found[1], found[2])


def _explains_more(drawn: list[Float[np.ndarray, "pixel 3"]]) -> bool:
    """Whether absorption explains more than clear glass, which was drawn first: a little of it hides other errors."""
    losses = np.stack([miss.mean(axis=0) for miss in drawn])
    return bool((losses.min(axis=0) < (1 - WORTH_IT) * losses[0]).any())


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


def curve_of(
    values: Float[np.ndarray, " value"], losses: Float[np.ndarray, " value"]
) -> tuple[tuple[float, float], ...]:
    return tuple(zip(values.tolist(), losses.tolist(), strict=True))


def vertex(places: Float[np.ndarray, " value"], losses: Float[np.ndarray, " value"]) -> float:
    """Where a parabola through losses is lowest, within the bracket; the place of the least where it is not convex."""
    if len(np.unique(places)) < 3:
        return float(places[losses.argmin()])
    a, b, _ = np.polyfit(places - places.mean(), losses, 2)
    if a <= 0:
        return float(places[losses.argmin()])
    return float(np.clip(places.mean() - b / (2 * a), places.min(), places.max()))
