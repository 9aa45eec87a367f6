"""Tests glass of revolution: that its meshes are closed, of the right size, and always of as many vertices."""

import dataclasses

import numpy as np
import pytest

from datagen.data.meshes import check_mesh, open_edges, signed_volume
from hyaline_photos.fit.shapes import OUTSIDE, POINTS, Axis, Revolution, evenly

AXIS = Axis(point=np.array([0.1, -0.2, 0.3]), direction=np.array([0.0, 0.6, 0.8]))
RADIUS, HEIGHT = 0.04, 0.1
CYLINDER = Revolution(axis=AXIS, outside=evenly(np.array([(0, 0), (RADIUS, 0), (RADIUS, HEIGHT)], float), OUTSIDE))
ROUND = np.pi * RADIUS**2
"""Square metres of a circle of this radius."""


@pytest.mark.parametrize(
    ("glass", "volume"),
    [
        (CYLINDER, ROUND * HEIGHT),
        (
            CYLINDER.hollowed(0.003 / RADIUS, 0.2, 0.02).having(foot=0.0),
            ROUND * HEIGHT - np.pi * (RADIUS - 0.003) ** 2 * 0.8 * HEIGHT,
        ),
    ],
    ids=["solid", "vessel"],
)
def test_a_mesh_is_closed_and_encloses_what_a_cylinder_does(glass: Revolution, volume: float) -> None:
    mesh = glass.mesh()
    check_mesh(mesh, where="glass")
    assert open_edges(mesh) == 0
    # The rim is a half circle, and circles are polygons.
    assert signed_volume(mesh) == pytest.approx(volume, rel=0.01)
    along = (mesh.vertices - AXIS.point) @ AXIS.direction
    assert (along.min(), along.max()) == pytest.approx((0, HEIGHT), abs=1e-6)


@pytest.mark.parametrize(
    ("wall", "floor", "corner"),
    [(0.015, 0.02, 0.02), (0.015, 0.9, 0.95), (0.08, 0.3, 0.95), (0.5, 0.02, 0.95), (0.5, 0.9, 0.02)],
)
def test_vessels_of_all_numbers_are_closed_and_of_equal_counts(wall: float, floor: float, corner: float) -> None:
    mesh = CYLINDER.hollowed(wall, floor, corner).mesh()
    assert open_edges(mesh) == 0
    assert signed_volume(mesh) > 0
    solid = CYLINDER.mesh()
    assert mesh.vertices.shape == solid.vertices.shape
    assert mesh.faces.shape == solid.faces.shape
    assert np.isfinite(mesh.normals).all()
    assert np.ptp(mesh.uv, axis=0) == pytest.approx((1, 1))


def test_a_solid_keeps_its_own_ends_and_a_vessel_does_not() -> None:
    cone = np.array([(0, 0), (RADIUS, 0), (0, HEIGHT)], float)
    both = dataclasses.replace(CYLINDER, solid=evenly(cone, POINTS))
    assert signed_volume(both.mesh()) == pytest.approx(ROUND * HEIGHT / 3, rel=0.02)
    hollow, cylinder = both.hollowed(0.1, 0.2, 0.3).mesh(), CYLINDER.hollowed(0.1, 0.2, 0.3).mesh()
    assert np.array_equal(hollow.vertices, cylinder.vertices)
    assert both.mesh().faces.shape == hollow.faces.shape
