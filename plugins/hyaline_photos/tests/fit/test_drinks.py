"""Tests drinks in vessels, seen by another tracer's first hits."""

import dataclasses

import numpy as np
import pytest
from support.silhouettes import views_around

from datagen.data.meshes import Mesh, check_mesh, face_corners, open_edges, signed_volume
from datagen.data.queries import windings
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.materials import Dielectric
from hyaline_photos.fit.kinds import find_holders, merged, with_drink
from hyaline_photos.fit.shapes import OUTSIDE, Axis, Revolution, evenly, revolved
from hyaline_photos.fit.views import Sightings

AXIS = Axis(point=np.zeros(3), direction=np.array([0.0, 0.0, 1.0]))
RADIUS, HEIGHT, LEVEL = 0.035, 0.09, 0.06
SIDE = evenly(np.array([(0, 0), (RADIUS, 0), (1.1 * RADIUS, HEIGHT)]), OUTSIDE)
OUTER = Revolution(axis=AXIS, outside=SIDE)
FULL = dataclasses.replace(OUTER.hollowed(0.08, 0.15, 0.3), drink_absorption=(1.0, 2.0, 30.0)).having(
    level=LEVEL, drink_ior=1.36
)
VESSEL, DRINK = BOTH = 1, 2


def ball(radius: float, height: float) -> Mesh:
    angles = np.linspace(-np.pi / 2, np.pi / 2, 60)
    outline = np.stack([radius * np.cos(angles).round(9), height + radius * np.sin(angles)], axis=1)
    return revolved(AXIS, outline)


def seen(*meshes: Mesh, unknown: tuple[int, ...]) -> Sightings:
    """Views from all around of objects with the ids 1, 2, ..."""
    use_mitsuba()
    from datagen.trace.peel import Peeler

    cameras, peeler = views_around(views=40, size=64), Peeler(meshes)
    known = Peeler(tuple(mesh for place, mesh in enumerate(meshes) if place + 1 not in unknown) or meshes)
    first, depth = [], []
    for view in range(len(cameras)):
        origin, directions = cameras[view].rays()
        hits = peeler.trace(origin, directions.reshape(-1, 3), 1)
        ids = (hits.shape[0] + 1).reshape(directions.shape[:2])
        behind = known.trace(origin, directions.reshape(-1, 3), 1)
        is_known = (behind.shape[0] >= 0) & (len(unknown) < len(meshes))
        first.append(np.where(np.isin(ids, unknown), ids, 0))
        depth.append(np.where(is_known, behind.t[0], np.inf).reshape(ids.shape))
    return Sightings(
        cameras=cameras,
        first=np.stack(first).astype(np.uint8),
        touched=np.stack(first) > 0,
        depth=np.stack(depth).astype(np.float32),
        unknown=unknown,
    )


def test_a_drink_is_closed_fills_the_hollow_and_gives_way_to_the_glass() -> None:
    (vessel, glass), (drink, liquid) = FULL.bodies(BOTH).values()
    check_mesh(drink, where="drink")
    assert open_edges(drink) == 0
    assert isinstance(glass, Dielectric)
    assert liquid == Dielectric(ior=1.36, absorption=(1.0, 2.0, 30.0), priority=-1)
    assert drink.vertices[:, 2].max() == pytest.approx(LEVEL)
    # A little more than the hollow: it reaches 0.3 of the wall into the glass.
    wall, floor = 0.08 * 1.1 * RADIUS, 0.15 * HEIGHT
    middle = RADIUS * (1 + 0.1 * (LEVEL + floor) / 2 / HEIGHT) - 0.7 * wall
    assert signed_volume(drink) == pytest.approx(np.pi * middle**2 * (LEVEL - floor + 0.3 * wall), rel=0.04)
    assert drink.vertices[:, 2].min() == pytest.approx(floor - 0.3 * wall, abs=2e-4)
    assert vessel.vertices.shape == OUTER.mesh().vertices.shape
    for level in (0.0, 0.02, 0.2):
        other = FULL.having(level=level).bodies(BOTH)[DRINK][0]
        assert other.vertices.shape == drink.vertices.shape
        assert open_edges(other) == 0


def test_a_glass_without_a_drink_hides_the_mesh_that_holds_its_place() -> None:
    for glass in (OUTER, OUTER.hollowed(0.08, 0.15, 0.3)):
        (body, _), (speck, liquid) = glass.bodies(BOTH).values()
        assert speck.vertices.shape == FULL.bodies(BOTH)[DRINK][0].vertices.shape
        assert liquid.priority < 0
        corners = face_corners(body).astype(np.float64)
        assert (windings(corners, speck.vertices[::500].astype(np.float64)) == 1).all()
        assert np.ptp(speck.vertices, axis=0).max() < 0.003 * HEIGHT


def test_masks_show_which_object_is_a_drink_and_its_level() -> None:
    (vessel, _), (drink, _) = FULL.bodies(BOTH).values()
    sightings = seen(vessel, drink, unknown=(VESSEL, DRINK))
    assert find_holders(sightings) == {DRINK: VESSEL}
    both = merged(sightings, {DRINK: VESSEL})
    assert both.unknown == (VESSEL,)
    assert np.array_equal(both.first > 0, sightings.first > 0)
    found = with_drink(OUTER, sightings, DRINK, VESSEL)
    assert found is not None
    assert found.numbers["level"] == pytest.approx(LEVEL, abs=0.0015)


def test_a_ball_beside_a_vessel_and_what_lies_in_a_solid_are_no_drinks() -> None:
    (vessel, _), (drink, _) = FULL.bodies(BOTH).values()
    beside = ball(0.03, 0.03)
    beside = dataclasses.replace(beside, vertices=beside.vertices + np.float32([0.075, 0, 0]))
    assert find_holders(seen(vessel, beside, unknown=(VESSEL, DRINK))) == {}
    sightings = seen(vessel, drink, unknown=(VESSEL, DRINK))
    assert with_drink(dataclasses.replace(OUTER, outside=ball_outline()), sightings, DRINK, VESSEL) is None
    low = dataclasses.replace(OUTER, outside=SIDE * [1, 0.5])
    assert with_drink(low, sightings, DRINK, VESSEL) is None


def ball_outline() -> np.ndarray:
    angles = np.linspace(-np.pi / 2, np.pi / 2, OUTSIDE)
    return np.stack([0.03 * np.cos(angles).round(9), 0.03 + 0.03 * np.sin(angles)], axis=1)
