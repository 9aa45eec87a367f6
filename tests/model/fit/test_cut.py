"""Tests that masks show facets and ribs around a vessel."""

import dataclasses

import numpy as np
import pytest
from support.silhouettes import sightings_of, traced

from datagen.data.meshes import Mesh
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.modelling import lathe, moved
from datagen.scene.procedural.solids import flutes, outside_only, polygon
from model.fit.cut import cut_in_masks, may_be_cut
from model.fit.kinds import choose_outside
from model.fit.lathe import Axis, evenly
from model.fit.shapes import OUTSIDE, Revolution
from model.fit.views import rays_near

use_mitsuba()

UP = np.array([0.0, 0.0, 1.0])
PLACE = (0.01, 0.0, 0.0)
SIDE = [(0.036 + 0.08 * z, z) for z in np.linspace(0.002, 0.09, 45)]
AROUND = {8: polygon(8), 12: flutes(12, 0.08)}
"""Flat facets, and ribs with grooves between them."""


def vessel(count: int) -> Mesh:
    """Cut between two heights."""
    outline = np.array([(0, 0.001), (0.036, 0.001), *SIDE, (0, 0.09)])
    around = outside_only(AROUND[count], len(outline) - 1, low=0.01, high=0.065) if count else None
    return moved(lathe(outline, around=around), PLACE)


def test_facets_are_counted_and_placed() -> None:
    outside = evenly(np.array([(0, 0.001), (0.036, 0.001), *SIDE]), OUTSIDE)
    glass = Revolution(axis=Axis(point=np.array(PLACE), direction=UP), outside=outside)
    found = cut_in_masks(glass, rays_near(sightings_of(traced(vessel(8)), views=16, size=64), 1))
    assert found.cut_count == 8
    # A corner is on the x axis, and another one, a quarter further, where turns are counted from.
    assert found.cut_turn == pytest.approx(0.5, abs=0.05)
    assert found.cut_low == pytest.approx(0.009, abs=0.004)
    assert found.cut_high == pytest.approx(0.064, abs=0.004)
    closed = dataclasses.replace(glass, outside=np.array([(0.0, 0.0), (1.0, 1.0), (0.0, 2.0)]))
    assert may_be_cut(glass) and not may_be_cut(closed)


@pytest.mark.full
@pytest.mark.parametrize("count", [0, *AROUND])
def test_a_vessel_gets_the_facets_that_it_has(count: int) -> None:
    sightings = sightings_of(traced(vessel(count)), views=40, size=128)
    outside = choose_outside(sightings, 1, UP, mask_errors=0, stands_on=lambda point, reach: 0.0)
    assert isinstance(outside.glass, Revolution)
    assert (outside.glass.cut_count or 0) == count
