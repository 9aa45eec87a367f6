"""Numbers, choices, colours, patterns and glass drawn for a random scene; the generator is always the caller's."""

import colorsys
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from datagen.scene.materials import Color, Dielectric, RoughDielectric, SolidTexture, ThinDielectric
from datagen.scene.substances import Ior

Choice = TypeVar("Choice")


def pick(choices: Sequence[Choice], *, rng: np.random.Generator) -> Choice:
    """One of several, each as likely as the others."""
    return choices[int(rng.integers(len(choices)))]


def weigh(choices: Mapping[Choice, float], *, rng: np.random.Generator) -> Choice:
    """One of several, with probabilities in proportion to their weights."""
    names = list(choices)
    ends = np.cumsum(list(choices.values()))
    return names[min(int(np.searchsorted(ends, rng.uniform(0, ends[-1]), side="right")), len(names) - 1)]


def hue_color(saturation: tuple[float, float], value: tuple[float, float], *, rng: np.random.Generator) -> Color:
    """A linear colour of any hue."""
    red, green, blue = colorsys.hsv_to_rgb(rng.random(), rng.uniform(*saturation), rng.uniform(*value))
    return red, green, blue


# Colours and patterns of opaque surfaces: pairs that contrast, so that what glass does to them is seen

PAIRS: tuple[tuple[Color, Color], ...] = (
    ((0.80, 0.76, 0.66), (0.62, 0.12, 0.09)),
    ((0.82, 0.80, 0.74), (0.05, 0.16, 0.34)),
    ((0.78, 0.62, 0.24), (0.10, 0.22, 0.30)),
    ((0.76, 0.74, 0.70), (0.06, 0.24, 0.14)),
    ((0.85, 0.50, 0.12), (0.30, 0.06, 0.05)),
    ((0.70, 0.66, 0.60), (0.07, 0.07, 0.08)),
    ((0.16, 0.40, 0.46), (0.82, 0.66, 0.46)),
    ((0.62, 0.40, 0.56), (0.14, 0.10, 0.24)),
    ((0.84, 0.72, 0.22), (0.42, 0.24, 0.06)),
    ((0.34, 0.52, 0.20), (0.80, 0.80, 0.62)),
)
"""Linear reflectances, the brighter first in most."""

WOODS: tuple[tuple[Color, Color], ...] = (
    ((0.56, 0.40, 0.26), (0.34, 0.21, 0.12)),
    ((0.62, 0.47, 0.32), (0.38, 0.25, 0.15)),
    ((0.34, 0.22, 0.14), (0.14, 0.08, 0.05)),
    ((0.52, 0.34, 0.20), (0.26, 0.13, 0.07)),
)


def color_pair(*, rng: np.random.Generator) -> tuple[Color, Color]:
    """Two colours that contrast, slightly other ones each time."""
    first, second = pick(PAIRS, rng=rng)
    if rng.random() < 0.3:
        first, second = second, first
    return _varied(first, rng), _varied(second, rng)


def pattern(scale: float, *, rng: np.random.Generator) -> SolidTexture:
    """Any pattern, with a period in metres."""
    kind = pick(("checker", "stripes", "marble", "speckle", "wood"), rng=rng)
    if kind == "wood":
        return wood(scale, rng=rng)
    larger = 2.5 if kind == "marble" else 1.0
    axis = pick(("x", "y", "z"), rng=rng)
    return SolidTexture(pattern=kind, colors=color_pair(rng=rng), scale=round(larger * scale, 4), axis=axis)


def wood(scale: float, *, rng: np.random.Generator) -> SolidTexture:
    """Planks or veneer."""
    first, second = pick(WOODS, rng=rng)
    colors = _varied(first, rng), _varied(second, rng)
    return SolidTexture(pattern="wood", colors=colors, scale=round(scale, 4), axis=pick(("x", "y"), rng=rng))


def _varied(color: Color, rng: np.random.Generator) -> Color:
    red, green, blue = (round(min(0.9, channel * rng.uniform(0.85, 1.12)), 3) for channel in color)
    return red, green, blue


# Glass and drinks

GLASSES = ("soda-lime", "bk7", "pyrex", "acrylic", "f2", "sf10", "sapphire")
"""Substances of solid things; any other index from 1.45 to 1.8 is as likely as all of them."""

DRINKS: dict[str, tuple[float, Color]] = {
    "water": (1.333, (0.4, 0.1, 0.1)),
    "tea": (1.335, (4.0, 12.0, 40.0)),
    "white wine": (1.345, (1.0, 2.5, 9.0)),
    "red wine": (1.35, (8.0, 55.0, 40.0)),
    "whisky": (1.36, (2.0, 10.0, 38.0)),
    "mint syrup": (1.37, (28.0, 4.0, 16.0)),
    "curacao": (1.36, (45.0, 12.0, 2.0)),
    "cherry juice": (1.35, (4.0, 45.0, 22.0)),
}
"""Index of refraction, and absorption in 1/m by channel."""

LIQUID_PRIORITY, ICE_PRIORITY = -1, 1
ICE = Dielectric(ior="ice", priority=ICE_PRIORITY)


def clear_ior(*, rng: np.random.Generator) -> Ior:
    """The index of some glass."""
    return pick(GLASSES, rng=rng) if rng.random() < 0.5 else round(rng.uniform(1.45, 1.8), 3)


SOLID_GLASS = {"clear": 0.5, "tinted": 0.36, "frosted": 0.14}


def solid_glass(
    thickness: float, *, rng: np.random.Generator, is_cut: bool = False, kinds: Mapping[str, float] = SOLID_GLASS
) -> Dielectric:
    """Glass of a body: by default most of it clear, much of it tinted, some frosted.

    Args:
        thickness: metres over which a tint has its full colour.
        is_cut: the body has flat facets, so that it is worth to let heavy glass part colours.
    """
    if is_cut and rng.random() < 0.5:
        return Dielectric(ior=round(rng.uniform(1.6, 1.8), 3), dispersion=round(rng.uniform(0.4, 0.8), 3))
    kind = weigh(kinds, rng=rng)
    ior = clear_ior(rng=rng)
    if kind == "frosted":
        return RoughDielectric(ior=ior, roughness=round(rng.uniform(0.05, 0.2), 3))
    absorption = tint(thickness, rng=rng) if kind == "tinted" else (0.0, 0.0, 0.0)
    return Dielectric(ior=ior, absorption=absorption)


def vessel_glass(wall: float, *, rng: np.random.Generator) -> Dielectric:
    """Glass of a vessel: smooth, so that one sees what is in it; now and then tinted."""
    absorption = tint(4 * wall, rng=rng) if rng.random() < 0.25 else (0.0, 0.0, 0.0)
    return Dielectric(ior=pick(("soda-lime", "pyrex", "bk7"), rng=rng), absorption=absorption)


def pane_glass(tinted: float, *, rng: np.random.Generator) -> ThinDielectric:
    """Glass of a thin pane, clear or of any hue.

    Args:
        tinted: share of all draws that have a colour.
    """
    if rng.random() >= tinted:
        return ThinDielectric(ior=pick(("soda-lime", "acrylic"), rng=rng))
    red, green, blue = (round(share, 3) for share in hue_color((0.35, 0.85), (0.8, 0.95), rng=rng))
    return ThinDielectric(ior=pick(("soda-lime", "acrylic"), rng=rng), tint=(red, green, blue))


def tint(thickness: float, *, rng: np.random.Generator) -> Color:
    """Absorption, 1/m, of glass that has a colour of any hue at this thickness."""
    color = hue_color((0.35, 0.8), (0.75, 0.95), rng=rng)
    red, green, blue = (round(float(-np.log(share) / thickness), 3) for share in color)
    return red, green, blue


def drink(*, rng: np.random.Generator) -> tuple[str, Dielectric]:
    """A liquid and what it is called. It gives way to the glass that it reaches into, and to ice."""
    name = pick(tuple(DRINKS), rng=rng)
    ior, absorption = DRINKS[name]
    return name, Dielectric(ior=ior, absorption=absorption, priority=LIQUID_PRIORITY)
