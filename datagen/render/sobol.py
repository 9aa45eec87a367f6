"""The path tracer's random numbers: Sobol's sequence, scrambled independently for each pixel and dimension.

Source: Owen 1995, "Randomly Permuted (t,m,s)-Nets and (t,s)-Sequences"; the scrambling is a hash by Laine and Karras
2011 with the constants of Burley 2020, "Practical Hash-based Owen Scrambling".
Import this module after `use_mitsuba`.
"""

import functools
import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import UInt32
from scipy.stats import qmc

from datagen.disk.errors import HyalineError
from datagen.terminal.command import hold_signals

NUM_DIMENSIONS = 128
"""Further dimensions repeat the first ones with another scrambling: still unbiased, but less evenly spread."""


class SobolPoints:
    """A fixed number of points for each of any number of pixels.

    Not a dataclass: Dr.Jit 1.5 would treat it as loop state and assign its fields.
    """

    def __init__(self, count: int, seed: int) -> None:
        """Args:
        count: points per pixel; powers of two spread evenly.
        seed: pictures with different seeds are independent.
        """
        self._count = dr.opaque(mi.UInt32, count)
        self._table = mi.UInt32(_reversed_points(count).ravel())
        # Opaque, so that another seed does not compile another kernel.
        self._seed = dr.opaque(mi.UInt32, seed)

    def scramble_of(self, pixel: "mi.UInt32") -> "mi.UInt32":
        """The scrambling seed of a pixel."""
        return _hash(_hash(pixel) + self._seed)

    def sample(
        self, scramble: "mi.UInt32", index: "mi.UInt32", dimension: "mi.UInt32", active: "mi.Bool"
    ) -> "mi.Float":
        """One coordinate, in [0, 1), of point `index` (below `count`)."""
        place = (dimension & (NUM_DIMENSIONS - 1)) * self._count + index
        seed = _hash(scramble + dimension * 0x9E3779B9)
        # Owen's scrambling changes each bit by the bits above it; multiplication by those below, hence reversed bits.
        bits = _reverse_bits(_permute(dr.gather(mi.UInt32, self._table, place, active), seed))
        return mi.Float(bits >> 8) * 2**-24

    def sample_2d(
        self, scramble: "mi.UInt32", index: "mi.UInt32", dimension: "mi.UInt32", active: "mi.Bool"
    ) -> "mi.Point2f":
        """Two coordinates in turn."""
        return mi.Point2f(*(self.sample(scramble, index, dimension + step, active) for step in range(2)))


@functools.lru_cache(maxsize=8)
def _reversed_points(count: int) -> UInt32[np.ndarray, "dimension point"]:
    """Sobol's points as 32-bit fractions, lowest bit first.

    Raises:
        HyalineError: SciPy could not read its direction numbers.
    """
    # SciPy 1.17 drops whatever is raised while it reads them, Ctrl-C included, and goes on with zeros.
    with hold_signals():
        sequence = qmc.Sobol(NUM_DIMENSIONS, scramble=False, bits=32)
    power = math.ceil(math.log2(count))
    points = sequence.random_base2(power)
    if (np.sort(points, axis=0) != np.arange(2**power)[:, None] / 2**power).any():
        raise HyalineError("SciPy could not read its direction numbers for Sobol's points; run the command again")
    return _reverse_bits((points[:count].T * 2.0**32).astype(np.uint32))


def _hash(x: Any) -> Any:
    """A hash of 32 bits in which each bit depends on all. Source: Wellons 2018, `lowbias32`."""
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)


def _permute(x: Any, seed: Any) -> Any:
    """A bijection in which each bit depends only on those below it."""
    x = x + seed
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x ^= x * factor
    return x


def _reverse_bits(x: Any) -> Any:
    """Reverses the bits of Dr.Jit's or NumPy's 32-bit integers."""
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        x = ((x >> shift) & mask) | ((x & mask) << shift)
    return (x >> 16) | (x << 16)
