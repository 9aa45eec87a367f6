"""Colours and patterns of opaque surfaces: pairs that contrast, so that what glass does to them is seen."""

import numpy as np

from datagen.scene.procedural.chance import between, happens, pick
from datagen.scene.textures import SolidTexture
from datagen.scene.values import Color

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
    if happens(0.3, rng=rng):
        first, second = second, first
    return _varied(first, rng), _varied(second, rng)


def pattern(scale: float, *, rng: np.random.Generator) -> SolidTexture:
    """Any pattern, with a period of so many metres."""
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
    red, green, blue = (round(min(0.9, channel * between(0.85, 1.12, rng=rng)), 3) for channel in color)
    return red, green, blue
