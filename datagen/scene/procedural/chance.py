"""Drawing numbers, choices and colours for a random scene; the generator is always the caller's."""

import colorsys
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from datagen.scene.values import Color

Choice = TypeVar("Choice")


def between(low: float, high: float, *, rng: np.random.Generator) -> float:
    """A number from an even distribution."""
    return float(rng.uniform(low, high))


def pick(choices: Sequence[Choice], *, rng: np.random.Generator) -> Choice:
    """One of several, each as likely as the others."""
    return choices[int(rng.integers(len(choices)))]


def weigh(choices: Mapping[Choice, float], *, rng: np.random.Generator) -> Choice:
    """One of several, as likely as its weight says."""
    names = list(choices)
    ends = np.cumsum(list(choices.values()))
    return names[min(int(np.searchsorted(ends, rng.uniform(0, ends[-1]), side="right")), len(names) - 1)]


def happens(chance: float, *, rng: np.random.Generator) -> bool:
    """True in a share `chance` of all draws."""
    return bool(rng.uniform() < chance)


def hue_color(saturation: tuple[float, float], value: tuple[float, float], *, rng: np.random.Generator) -> Color:
    """A linear colour of any hue."""
    red, green, blue = colorsys.hsv_to_rgb(
        between(0, 1, rng=rng), between(*saturation, rng=rng), between(*value, rng=rng)
    )
    return red, green, blue
