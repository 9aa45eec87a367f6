"""A map of caustics: from which directions glass and mirrors bring the light of lamps to places on matt surfaces.

Photons tell the path tracer where to look for small lamps (render/photons.py). The map only chooses directions, with a
known density: pictures are unbiased however few or wrong its photons are.
Source: Jensen 1995, "Importance Driven Path Tracing using the Photon Map".
Import this module after `use_mitsuba`.
"""

import math
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float32, Shaped, UInt64

Lanes = Any

SIDES = (512, 256, 128, 64, 32)
"""Each hemisphere of directions is divided into this many times as many bins of equal area, from
0.2 to 3 degrees wide."""
PHOTONS_PER_BIN = 1.25
"""Bins are the smallest of which those in use have as many photons on average: finer ones would leave holes in a lamp
that looks large, and rays through a hole are rare and bright."""
CELLS = 1 << 18
"""Entries of the hash table of places."""
PHOTONS_PER_CELL = 32
"""Places are divided into cubes, so small that on average at most this many photons lie in one."""
MAX_HALVINGS = 12
"""Smallest cubes: the extent of all photons, halved this often."""
COPIES = 8
"""Each photon counts this often, each time moved at random, so that the map has no holes between photons."""
SPREAD = 2
"""Bins over which copies of a photon are spread in direction; in place, they are spread over a cube."""


class Spot(NamedTuple):
    """The entries of the map around a place: `first` to `end`, none if they are equal."""

    first: Lanes
    end: Lanes


class CausticMap:
    """The distribution of photons over directions in each cube of space.

    Not a dataclass: Dr.Jit 1.5 would treat it as loop state and assign its fields.
    """

    def __init__(self, p: "mi.Point3f", d: "mi.Vector3f", power: "mi.Float", sampler: "mi.Sampler") -> None:
        """Args:
        p: where photons arrive on matt surfaces; at least one.
        d: unit directions that they come from.
        sampler: random numbers, as many at once as there are photons.
        """
        self._cube = dr.opaque(mi.Float, _cube_size(np.array(p).T))
        cell, most = _cell(p, self._cube), dr.width(d) / PHOTONS_PER_BIN
        fills = (side for side in SIDES if _count_distinct(_entries(cell, _bin_of(d, side), side)) <= most)
        self._side = next(fills, SIDES[-1])
        self._num_bins = 2 * self._side**2
        copies = [self._places(p, d, sampler) for _ in range(COPIES)]
        # Cells in ascending order, the bins of each in ascending order, each entry with the power of its photons.
        found, index = np.unique(np.concatenate(copies), return_inverse=True)
        powers = np.bincount(index, np.tile(np.array(power), COPIES))  # Added in the order of the photons.
        cell, key = (found // self._num_bins).astype(np.int64), found % self._num_bins
        first = np.searchsorted(cell, np.arange(CELLS + 1))
        share = powers / np.bincount(cell, powers)[cell]
        below = np.concatenate([[0.0], np.cumsum(share)])  # Sums of powers would lose dim cells.
        self._first = mi.UInt32(first.astype(np.uint32))
        self._bin = mi.UInt32(key.astype(np.uint32))
        self._share = mi.Float(share.astype(np.float32))
        self._share_up_to = mi.Float((below[1:] - below[first[cell]]).astype(np.float32))
        self._num_steps = int(np.diff(first).max()).bit_length()

    def find(self, p: "mi.Point3f", active: "mi.Bool") -> Spot:
        """Looks up the entries at these places."""
        cell = _cell(p, self._cube)
        return Spot(*(dr.gather(mi.UInt32, self._first, cell + step, active) for step in range(2)))

    def sample(self, spot: Spot, sample1: "mi.Float", sample2: "mi.Point2f", active: "mi.Bool") -> "mi.Vector3f":
        """A unit direction from a spot that has entries; all in a bin are equally likely."""
        place = self._search(spot, self._share_up_to, lambda share: share <= sample1, active)
        key = dr.gather(mi.UInt32, self._bin, dr.minimum(place, spot.end - 1), active)
        x, y = key & (self._side - 1), (key // self._side) & (self._side - 1)
        disk = mi.warp.square_to_uniform_disk_concentric((mi.Point2f(x, y) + sample2) / self._side)
        r2 = dr.squared_norm(disk)
        xy = disk * dr.safe_sqrt(2 - r2)
        return mi.Vector3f(xy.x, xy.y, dr.select(key < self._side**2, 1 - r2, r2 - 1))

    def pdf(self, spot: Spot, d: "mi.Vector3f", active: "mi.Bool") -> "mi.Float":
        """The density, over solid angle, with which `sample` gives a direction."""
        key = _bin_of(d, self._side)
        place = self._search(spot, self._bin, lambda other: other < key, active)
        is_there = active & (place < spot.end)
        is_there &= dr.gather(mi.UInt32, self._bin, place, is_there) == key
        return dr.gather(mi.Float, self._share, place, is_there) * (self._num_bins / (4 * math.pi))

    def _search(self, spot: Spot, table: Lanes, is_before: Any, active: Lanes) -> Lanes:
        """The first entry of a spot that is not before what is sought, or the end."""
        low, high = spot
        for _ in range(self._num_steps):
            middle = (low + high) >> 1
            is_open = active & (low < high)
            goes_up = is_open & is_before(dr.gather(type(table), table, middle, is_open))
            low, high = dr.select(goes_up, middle + 1, low), dr.select(goes_up, high, middle)
        return low

    def _places(self, p: Lanes, d: Lanes, sampler: "mi.Sampler") -> UInt64[np.ndarray, " photon"]:
        """Cell and bin of each photon, moved at random."""
        moved = p + self._cube * (mi.Vector3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d()) - 0.5)
        s, t = mi.coordinate_system(d)
        spread = SPREAD * math.sqrt(4 * math.pi / self._num_bins)
        turned = d + spread * ((sampler.next_1d() - 0.5) * s + (sampler.next_1d() - 0.5) * t)
        return _entries(_cell(moved, self._cube), _bin_of(dr.normalize(turned), self._side), self._side)


def _entries(cell: Lanes, key: Lanes, side: int) -> UInt64[np.ndarray, " photon"]:
    return np.array(cell).astype(np.uint64) * np.uint64(2 * side * side) + np.array(key)


def _count_distinct(values: Shaped[np.ndarray, " photon"]) -> int:
    """How many values differ; `len(np.unique(values))` hashes them, which takes 15 times as long (NumPy 2.4)."""
    ordered = np.sort(values)
    return 1 + int(np.count_nonzero(ordered[1:] != ordered[:-1]))


def _cube_size(p: Float32[np.ndarray, "photon 3"]) -> float:
    """The edge of the cubes that hold few photons each."""
    extent = max(float(np.ptp(p, axis=0).max()), 1e-6)
    size = extent
    for _ in range(MAX_HALVINGS):
        places = np.floor((p - p.min(axis=0)) / size).astype(np.int64)
        if len(p) <= PHOTONS_PER_CELL * _count_distinct(places @ (1 << np.array([0, 20, 40]))):
            break
        size /= 2
    return size


def _cell(p: Lanes, size: Lanes) -> Lanes:
    """The place of a cube in the hash table; cubes that share one are told apart by nothing, which is not wrong."""
    x, y, z = (mi.UInt32(mi.Int32(dr.floor(axis / size))) for axis in p)
    mixed = (x * 0x9E3779B1) ^ (y * 0x85EBCA77) ^ (z * 0xC2B2AE3D)
    mixed = (mixed ^ (mixed >> 15)) * 0x2C1B3C6D
    return (mixed ^ (mixed >> 13)) & (CELLS - 1)


def _bin_of(d: Lanes, side: int) -> Lanes:
    """The bin of a unit direction. Hemispheres are mapped to disks (Lambert's azimuthal map), and disks to squares."""
    disk = mi.Point2f(d.x, d.y) * dr.rsqrt(1 + dr.abs(d.z))
    x, y = (
        mi.UInt32(dr.clip(mi.Int32(axis * side), 0, side - 1))
        for axis in mi.warp.uniform_disk_to_square_concentric(disk)
    )
    return dr.select(d.z < 0, side * side, 0) + y * side + x
