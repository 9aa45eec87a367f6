"""Tests of how far a mesh is from the true one, against closed forms."""

import dataclasses

import numpy as np
import pytest
import trimesh
from support.meshes import box, mesh_of

from datagen.data.meshes import Mesh
from datagen.data.queries import nearest_points
from datagen.scene.modelling import ball, moved
from hyaline_photos.report import measure_walls, shape_errors

BALL = ball(1.0, subdivisions=4)


def shell(inner: float) -> Mesh:
    """A hollow ball of radius 1."""
    outside, cavity = trimesh.creation.icosphere(3, 1.0), trimesh.creation.icosphere(3, inner)
    cavity.invert()
    return mesh_of(trimesh.util.concatenate([outside, cavity]))


def cup(wall: float, floor: float) -> Mesh:
    """A beaker of height 1 and radius 0.5, open at the top."""
    inner = 0.5 - wall
    line = [(0, 0), (0.5, 0), (0.5, 1), (inner, 1), (inner, floor), (0, floor)]
    return mesh_of(trimesh.creation.revolve(line, sections=96))


def test_distances_agree_with_a_loop_over_all_triangles() -> None:
    from trimesh.triangles import closest_point

    rng = np.random.default_rng(0)
    # Triangles from a centimetre to ten metres, so that every class of sizes takes part.
    middles, sides = rng.normal(size=(60, 1, 3)), rng.normal(size=(60, 3, 3))
    corners = middles + sides * 10 ** rng.uniform(-2, 1, (60, 1, 1))
    points = rng.normal(size=(300, 3)) * 3
    distance, found = nearest_points(points, corners)
    slow = [np.linalg.norm(closest_point(corners, np.tile(p, (60, 1))) - p, axis=-1).min() for p in points]
    np.testing.assert_allclose(distance, slow, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - found.position, axis=-1), slow, rtol=1e-12)
    own = closest_point(corners[found.face], points)
    np.testing.assert_allclose(own, found.position, atol=1e-12)


def test_a_shifted_ball_has_the_mean_distance_and_the_median_angle_of_the_formula() -> None:
    shift = 0.1
    cosine = np.linspace(-1, 1, 100_001)  # On a ball, heights are evenly spread.
    away = np.sqrt(1 + shift**2 + 2 * shift * cosine)
    found = shape_errors(moved(BALL, (0, 0, shift)), BALL)
    assert found.chamfer == pytest.approx(np.abs(away - 1).mean(), rel=0.02)
    angles = np.degrees(np.arccos((1 + shift * cosine) / away))
    assert found.normal_deg == pytest.approx(np.median(angles), rel=0.02)


def test_turned_normals_are_an_error_of_normals_alone() -> None:
    truth = box((1, 1, 1))
    angle = np.radians(10)
    turn = trimesh.transformations.rotation_matrix(angle, [1, 1, 1])[:3, :3].astype(np.float32)
    found = shape_errors(dataclasses.replace(truth, normals=truth.normals @ turn.T), truth)
    # Of any axis-parallel direction, by Rodrigues' formula.
    expected = np.degrees(np.arccos(np.cos(angle) + (1 - np.cos(angle)) / 3))
    assert found.normal_deg == pytest.approx(expected, rel=1e-3)
    assert found.chamfer < 1e-6


def test_the_wall_of_a_hollow_ball_is_the_difference_of_its_radii() -> None:
    found = shape_errors(shell(0.9), shell(0.85))
    assert found.thickness == pytest.approx(0.1, rel=0.02)
    assert found.true_thickness == pytest.approx(0.15, rel=0.02)
    assert measure_walls(shell(0.9)).max() < 0.11  # From the outside alone: the cavity is 1.8 wide.
    assert np.median(measure_walls(BALL)) == pytest.approx(2, rel=2e-3)


def test_the_wall_and_the_floor_of_a_cup_are_told_apart() -> None:
    thickness = measure_walls(cup(0.04, 0.1))
    assert np.median(thickness) == pytest.approx(0.04, rel=1e-3)
    # The floor is seen from below and through the opening; besides it, the outside is the wall, its rim and its foot.
    floor = 0.46**2
    expected = 2 * floor / (0.5**2 + floor + 2 * 0.5 + 0.5**2 - floor)
    assert (np.abs(thickness - 0.1) < 1e-3).mean() == pytest.approx(expected, abs=0.03)


def test_an_open_surface_has_no_wall() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    pane = mesh_of(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]))
    found = shape_errors(pane, pane)
    assert found.thickness is None and found.chamfer < 1e-12
