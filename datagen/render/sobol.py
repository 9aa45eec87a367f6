"""The random numbers that paths are made of: Sobol's sequence, scrambled anew for each pixel and dimension.

Points of a pixel are spread evenly not in pairs of dimensions alone, as those of Mitsuba's `multijitter` are, but over
many bounces at once. Source: Owen 1995, "Randomly Permuted (t,m,s)-Nets and (t,s)-Sequences"; the scrambling is a hash,
of Laine and Karras 2011 with the constants of Burley 2020, "Practical Hash-based Owen Scrambling".
Import this module after `use_mitsuba`; vectorised variants only.
"""

import functools
import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import UInt32
from scipy.stats import qmc

NUM_DIMENSIONS = 128
"""Dimensions beyond them are the first ones again, scrambled otherwise: still unbiased, less evenly spread."""


class SobolPoints:
    """Points of a given number, for any number of pixels.

    No dataclass: Dr.Jit 1.5 would take it for state of a loop and assign its fields.
    """

    def __init__(self, count: int, seed: int) -> None:
        """Args:
        count: of points per pixel; evenly spread where it is a power of two.
        seed: pictures of different seeds are independent.
        """
        self._count = dr.opaque(mi.UInt32, count)
        self._table = mi.UInt32(_reversed_points(count).ravel())
        # Opaque, so that another seed is not another kernel.
        self._seed = dr.opaque(mi.UInt32, seed)

    def scramble_of(self, pixel: "mi.UInt32") -> "mi.UInt32":
        """What makes the points of a pixel its own."""
        return _hash(_hash(pixel) + self._seed)

    def sample(
        self, scramble: "mi.UInt32", index: "mi.UInt32", dimension: "mi.UInt32", active: "mi.Bool"
    ) -> "mi.Float":
        """One coordinate, in [0, 1), of point `index` (below `count`)."""
        place = (dimension & (NUM_DIMENSIONS - 1)) * self._count + index
        seed = _hash(scramble + dimension * 0x9E3779B9)
        # Owen's scrambling decides on each bit by those above it, which a multiplication does from below.
        bits = _reverse_bits(_permute(dr.gather(mi.UInt32, self._table, place, active), seed))
        return mi.Float(bits >> 8) * 2**-24

    def sample_2d(
        self, scramble: "mi.UInt32", index: "mi.UInt32", dimension: "mi.UInt32", active: "mi.Bool"
    ) -> "mi.Point2f":
        """Two coordinates in turn."""
        return mi.Point2f(*(self.sample(scramble, index, dimension + step, active) for step in range(2)))


@functools.lru_cache(maxsize=8)
def _reversed_points(count: int) -> UInt32[np.ndarray, "dimension point"]:
    """Sobol's points as 32-bit fractions, lowest bit first."""
    sequence = qmc.Sobol(NUM_DIMENSIONS, scramble=False, bits=32)
    points = sequence.random_base2(math.ceil(math.log2(count)))[:count]
    return _reverse_bits((points.T * 2.0**32).astype(np.uint32))


def _hash(x: Any) -> Any:
    """A hash of 32 bits in which each bit depends on all. Source: Wellons 2018, `lowbias32`."""
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)


def _permute(x: Any, seed: Any) -> Any:
    """A bijection in which each bit depends on those below it alone."""
    x = x + seed
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x ^= x * factor
    return x


def _reverse_bits(x: Any) -> Any:
    """Of Dr.Jit's or NumPy's 32-bit integers."""
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        x = ((x >> shift) & mask) | ((x & mask) << shift)
    return (x >> 16) | (x << 16)
