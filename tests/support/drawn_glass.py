"""A vessel, and losses by its numbers as if it were drawn, for tests of searches."""

import dataclasses
from collections.abc import Callable

import numpy as np

from hyaline_photos.fit.search import penalty
from hyaline_photos.fit.shapes import OUTSIDE, Axis, Revolution, evenly

PIXELS = 400
IS_EVEN = np.arange(PIXELS) % 2 == 0
OUTSIDE_OF = Revolution(
    axis=Axis(point=np.zeros(3), direction=np.array([0.0, 0.0, 1.0])),
    outside=evenly(np.array([(0, 0), (0.05, 0), (0.05, 0.1)]), OUTSIDE),
)
TRUTH = dataclasses.replace(OUTSIDE_OF.hollowed(0.07, 0.13, 0.45), absorption=(6.0, 0.0, 20.0)).having(
    ior=1.53, taper=0.9, foot=0.003
)


def misses_of(truth: Revolution) -> Callable[[Revolution], np.ndarray]:
    """Pixels that differ as much as the numbers of a glass do, each in its own way, over noise."""
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(6, PIXELS, 1)) * np.reshape([1, 1, 0.2, 0.1, 4, 0.5], (6, 1, 1))
    noise = rng.normal(size=(PIXELS, 3)) * 0.01
    lengths = np.abs(rng.normal(size=(PIXELS, 1))) * 0.01

    def numbers(glass: Revolution) -> np.ndarray:
        if "wall" not in glass.numbers:
            return np.array([2.0, 2.0, 0, 0, glass.numbers["ior"], 0])
        names = ("wall", "floor", "corner", "foot")
        logs = [np.log(glass.numbers[name]) for name in names]
        return np.array([*logs, glass.numbers["ior"], np.log(glass.numbers["taper"])])

    def miss(glass: Revolution) -> np.ndarray:
        shift = numbers(glass) - numbers(truth)
        tint = np.exp(-np.array(glass.absorption) * lengths) - np.exp(-np.array(truth.absorption) * lengths)
        return penalty(0.1 * np.einsum("n,npc->pc", shift, weights) + tint + noise)

    return miss
