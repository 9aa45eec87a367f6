"""Tests glass of revolution: that its meshes are closed, of the right size, and always of as many vertices."""

import dataclasses
from math import gamma

import numpy as np
import pytest

from datagen.data.meshes import MIN_AREA, Mesh, check_mesh, face_areas, open_edges, signed_volume
from hyaline_photos.fit.found import from_state, to_state
from hyaline_photos.fit.lathe import Axis, evenly, revolved
from hyaline_photos.fit.section import MOST_SHARPNESS, SHARP, Section
from hyaline_photos.fit.shapes import OUTSIDE, POINTS, Revolution

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


@pytest.mark.parametrize("wall", [0.015, 0.08, 0.5])
@pytest.mark.parametrize("floor", [0.02, 0.3, 0.9])
@pytest.mark.parametrize("corner", [0.02, 0.95])
def test_vessels_of_all_numbers_are_closed_and_of_equal_counts(wall: float, floor: float, corner: float) -> None:
    mesh = CYLINDER.hollowed(wall, floor, corner).mesh()
    assert open_edges(mesh) == 0
    assert signed_volume(mesh) > 0
    solid = CYLINDER.mesh()
    assert mesh.vertices.shape == solid.vertices.shape
    assert mesh.faces.shape == solid.faces.shape
    assert np.isfinite(mesh.normals).all()
    assert np.ptp(mesh.uv, axis=0) == pytest.approx((1, 1))


def test_what_stands_in_a_vessel_limits_its_floor() -> None:
    up = AXIS.direction
    straw = revolved(
        Axis(point=AXIS.point + 0.013 * up, direction=up),
        np.array([(0, 0), (0.002, 0), (0.002, 0.08), (0, 0.08)], float),
    )
    book = dataclasses.replace(straw, vertices=straw.vertices + np.float32([1, 0, 0]))
    assert CYLINDER.around([book]).most_floor is None
    holding = CYLINDER.around([book, straw])
    assert holding.most_floor == pytest.approx(0.013, abs=0.001)
    assert holding.hollowed(0.05, 0.5, 0.3).numbers["floor"] == holding.most_floor
    assert holding.hollowed(0.05, 0.1, 0.3).numbers["floor"] == pytest.approx(0.1 * HEIGHT)


def test_a_prism_encloses_what_a_superellipse_does_and_its_normals_are_those_of_its_faces() -> None:
    power = 5.0
    prism = dataclasses.replace(CYLINDER, section=Section(sides=4, sharpness=power, turn=0.4))
    mesh = prism.mesh()
    check_mesh(mesh, where="prism")
    assert open_edges(mesh) == 0
    area = 4 * RADIUS**2 * gamma(1 + 1 / power) ** 2 / gamma(1 + 2 / power)
    assert signed_volume(mesh) == pytest.approx(area * HEIGHT, rel=0.01)
    assert off_normal(mesh).max() < 12
    assert prism.hollowed(0.1, 0.2, 0.3).mesh().faces.shape == mesh.faces.shape


@pytest.mark.parametrize("sharpness", [MOST_SHARPNESS, SHARP])
def test_an_oblong_vessel_has_a_wall_of_one_thickness(sharpness: float) -> None:
    wall, floor, stretch = 0.002, 0.2 * HEIGHT, 0.01
    section = Section(sides=4, sharpness=sharpness, turn=0.4, stretch=stretch)
    block = dataclasses.replace(CYLINDER, section=section)
    assert block.kind == "oblong"
    tank = block.hollowed(wall / RADIUS, 0.2, 0.02).having(foot=1e-6, level=0.6 * HEIGHT, drink_ior=1.33)
    solid, vessel, drink = block.mesh(), *(mesh for mesh, _ in tank.bodies())
    assert solid.faces.shape == vessel.faces.shape
    for mesh in (solid, vessel, drink):
        mesh = dataclasses.replace(mesh, faces=mesh.faces[face_areas(mesh) >= MIN_AREA])
        check_mesh(mesh, where="tank")
        assert open_edges(mesh) == 0
        assert off_normal(mesh).max() < 20
    area = 4 * RADIUS * (RADIUS + stretch)
    assert signed_volume(solid) == pytest.approx(area * HEIGHT, rel=0.01)
    inside = 4 * (RADIUS - wall) * (RADIUS - wall + stretch) * (HEIGHT - floor)
    assert signed_volume(solid) - signed_volume(vessel) == pytest.approx(inside, rel=0.02)


def off_normal(mesh: Mesh) -> np.ndarray:
    """Degrees between each face's normal and the mean of those of its vertices."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    shaded = mesh.normals[mesh.faces].mean(axis=1)
    cosines = (across * shaded).sum(axis=1) / np.linalg.norm(across, axis=1) / np.linalg.norm(shaded, axis=1)
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def test_flat_ends_of_a_solid_are_sunk_as_spheres() -> None:
    line = np.array([*np.linspace((0, 0), (RADIUS, 0), 40), *np.linspace((RADIUS, HEIGHT), (0, HEIGHT), 40)])
    whole = dataclasses.replace(CYLINDER, solid=line).having(dish=0.0)
    depth = 0.2 * RADIUS
    mesh = whole.having(dish=0.2).mesh()
    assert mesh.faces.shape == whole.mesh().faces.shape
    mesh = dataclasses.replace(mesh, faces=mesh.faces[face_areas(mesh) >= MIN_AREA])
    check_mesh(mesh, where="glass")
    assert open_edges(mesh) == 0
    cap = np.pi * depth * (3 * RADIUS**2 + depth**2) / 6
    assert signed_volume(whole.mesh()) - signed_volume(mesh) == pytest.approx(2 * cap, rel=0.01)
    # However deep, the ends do not meet.
    assert signed_volume(dataclasses.replace(whole, solid=line * [3, 0.1]).having(dish=0.9).mesh()) > 0


def test_a_foot_sags_towards_its_edge() -> None:
    stem = np.array([(0, 0), (46, 0), (46, 4), (6, 16), (5, 100), (45, 140), (50, 200), (45, 270)]) / 1e3
    glass = Revolution(axis=AXIS, outside=evenly(stem, 400)).hollowed(0.04, 0.42, 0.3)
    assert "sag" in glass.numbers
    volumes = []
    for sag in (1.0, 2.0):
        mesh = glass.having(sag=sag).mesh()
        mesh = dataclasses.replace(mesh, faces=mesh.faces[face_areas(mesh) >= MIN_AREA])
        check_mesh(mesh, where="glass")
        assert open_edges(mesh) == 0
        volumes.append(signed_volume(mesh))
    radii = np.linspace(0.006, 0.046, 2001)
    rise = (0.046 - radii) / 0.04
    lost = np.trapezoid(2 * np.pi * radii * 0.012 * (rise - rise**2), radii)
    assert volumes[0] - volumes[1] == pytest.approx(lost, rel=0.1)


@pytest.mark.parametrize("line", [[(0, 0), (35, 0), (40, 90)], [(0, 0), (40, 0), (40, 90), (15, 110), (15, 200)]])
def test_a_tumbler_and_the_shoulder_of_a_bottle_have_no_foot(line: list[tuple[float, float]]) -> None:
    vessel = Revolution(axis=AXIS, outside=evenly(np.array(line) / 1e3, 400)).hollowed(0.1, 0.1, 0.3)
    assert "sag" not in vessel.numbers


def test_a_solid_keeps_its_own_ends_and_a_vessel_does_not() -> None:
    cone = np.array([(0, 0), (RADIUS, 0), (0, HEIGHT)], float)
    both = dataclasses.replace(CYLINDER, solid=evenly(cone, POINTS))
    assert signed_volume(both.mesh()) == pytest.approx(ROUND * HEIGHT / 3, rel=0.02)
    hollow, cylinder = both.hollowed(0.1, 0.2, 0.3).mesh(), CYLINDER.hollowed(0.1, 0.2, 0.3).mesh()
    assert np.array_equal(hollow.vertices, cylinder.vertices)
    assert both.mesh().faces.shape == hollow.faces.shape


def test_a_state_gives_the_same_glass_back() -> None:
    square = dataclasses.replace(CYLINDER, section=Section(sides=4, sharpness=6.0, turn=0.2), solid=CYLINDER.outline())
    glass = dataclasses.replace(square.hollowed(0.08, 0.2, 0.3), absorption=(1.0, 2.0, 3.0)).having(roughness=0.1)
    again = from_state(to_state(glass))
    assert np.array_equal(again.mesh().vertices, glass.mesh().vertices)
    assert again.material() == glass.material()
