"""The glasses and liquids of random scenes: clear, tinted, frosted and heavy; water, wine, juice."""

import numpy as np

from datagen.scene.materials import Dielectric, RoughDielectric, ThinDielectric
from datagen.scene.procedural.chance import between, happens, hue_color, pick, weigh
from datagen.scene.substances import Ior
from datagen.scene.values import Color

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
    return pick(GLASSES, rng=rng) if happens(0.5, rng=rng) else round(between(1.45, 1.8, rng=rng), 3)


def solid_glass(thickness: float, *, rng: np.random.Generator, is_cut: bool = False) -> Dielectric:
    """Glass of a body: most of it clear, much of it tinted, some frosted.

    Args:
        thickness: metres over which a tint has its full colour.
        is_cut: the body has flat facets, so that it is worth to let heavy glass part colours.
    """
    if is_cut and happens(0.5, rng=rng):
        return Dielectric(ior=round(between(1.6, 1.8, rng=rng), 3), dispersion=round(between(0.4, 0.8, rng=rng), 3))
    kind = weigh({"clear": 0.5, "tinted": 0.36, "frosted": 0.14}, rng=rng)
    ior = clear_ior(rng=rng)
    if kind == "frosted":
        return RoughDielectric(ior=ior, roughness=round(between(0.05, 0.2, rng=rng), 3))
    absorption = tint(thickness, rng=rng) if kind == "tinted" else (0.0, 0.0, 0.0)
    return Dielectric(ior=ior, absorption=absorption)


def vessel_glass(wall: float, *, rng: np.random.Generator) -> Dielectric:
    """Glass of a vessel: smooth, so that one sees what is in it; now and then tinted."""
    absorption = tint(4 * wall, rng=rng) if happens(0.25, rng=rng) else (0.0, 0.0, 0.0)
    return Dielectric(ior=pick(("soda-lime", "pyrex", "bk7"), rng=rng), absorption=absorption)


def pane_glass(tinted: float, *, rng: np.random.Generator) -> ThinDielectric:
    """Glass of a thin pane, clear or of any hue.

    Args:
        tinted: share of all draws that have a colour.
    """
    if not happens(tinted, rng=rng):
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
