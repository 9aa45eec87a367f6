"""Tests the random numbers of paths against SciPy's and against what makes a sequence Sobol's."""

import subprocess
import sys
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import qmc

from datagen.machine.mitsuba_variant import use_mitsuba

use_mitsuba()


import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from datagen.render.sobol import NUM_DIMENSIONS, SobolPoints  # noqa: E402


def points_of(pixel: int, count: int, num_dimensions: int, *, seed: int = 0) -> np.ndarray:
    """(point, dimension), in [0, 1)."""
    return points_of_pixels([pixel], count, num_dimensions, seed=seed)[0]


def points_of_pixels(pixels: Sequence[int], count: int, num_dimensions: int, *, seed: int = 0) -> np.ndarray:
    """(pixel, point, dimension), in [0, 1)."""
    points = SobolPoints(count, seed)
    index = mi.UInt32(np.tile(np.arange(count), len(pixels)))
    scramble = points.scramble_of(mi.UInt32(np.repeat(pixels, count)))
    # As a literal, each dimension would compile a kernel of its own.
    dimensions = [dr.opaque(mi.UInt32, dimension) for dimension in range(num_dimensions)]
    columns = [np.array(points.sample(scramble, index, dimension, mi.Bool(True))) for dimension in dimensions]
    return np.stack(columns, axis=1).astype(np.float64).reshape(len(pixels), count, num_dimensions)


@pytest.mark.parametrize("pixel", [0, 1, 77777])
def test_every_dimension_has_one_point_in_every_stratum(pixel: int) -> None:
    points = points_of(pixel, 64, NUM_DIMENSIONS)
    assert points.min() >= 0 and points.max() < 1
    assert (np.sort((points * 64).astype(int), axis=0) == np.arange(64)[:, None]).all()


@pytest.mark.parametrize("shape", [(64, 1), (16, 4), (8, 8), (2, 32)])
def test_the_first_two_have_one_point_in_every_elementary_box(shape: tuple[int, int]) -> None:
    cells = (points_of(5, 64, 2) * shape).astype(int)
    assert len({tuple(cell) for cell in cells}) == 64


def test_points_are_as_even_over_many_dimensions_as_scipys() -> None:
    ours = np.mean([qmc.discrepancy(points_of(pixel, 128, 8)) for pixel in range(8)])
    scipys = np.mean([qmc.discrepancy(qmc.Sobol(8, rng=seed).random(128)) for seed in range(8)])
    assert ours == pytest.approx(scipys, rel=0.15)
    assert ours < 0.3 * qmc.discrepancy(np.random.default_rng(0).random((128, 8)))


def test_pixels_seeds_and_repeated_dimensions_are_independent() -> None:
    place = points_of_pixels(range(400), 4, 3)[:, 1]
    assert np.abs(np.corrcoef(place.T) - np.eye(3)).max() < 0.15
    assert np.abs(np.corrcoef(place[1:, 0], place[:-1, 0])[0, 1]) < 0.15
    assert place.mean() == pytest.approx(0.5, abs=0.03)
    one = points_of(3, 256, NUM_DIMENSIONS + 1)
    assert not np.isin(points_of(3, 256, 2, seed=1)[:, 0], one[:, 0]).any()
    assert not np.array_equal(one[:, 0], one[:, NUM_DIMENSIONS])


def test_a_count_that_is_no_power_of_two_is_the_beginning_of_the_sequence() -> None:
    np.testing.assert_array_equal(points_of(9, 24, 5), points_of(9, 32, 5)[:24])


FIRST_POINTS = """
import os, signal
import numpy as np
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.terminal.command import Stopped

use_mitsuba()
from datagen.render.sobol import SobolPoints

read = np.load

def disturbed(*args, **options):
    os.kill(os.getpid(), signal.SIGINT)
    return read(*args, **options)

np.load = disturbed
try:
    SobolPoints(16, 0)
except (HyalineError, KeyboardInterrupt, Stopped) as stop:
    print(type(stop).__name__, stop)
np.load = read
table = np.sort(np.array(SobolPoints(16, 0)._table).reshape(-1, 16), axis=1)
print("points differ:", (np.diff(table.astype(np.int64), axis=1) > 0).all())
"""


@pytest.mark.promise("R11")
def test_a_ctrl_c_while_scipy_prepares_is_neither_lost_nor_makes_all_points_alike() -> None:
    """SciPy drops what is raised there and goes on with zeros: pictures as of one sample a pixel."""
    answer = subprocess.run([sys.executable, "-c", FIRST_POINTS], capture_output=True, text=True, check=True)
    assert answer.stdout.splitlines() == ["Stopped stopped", "points differ: True"]
