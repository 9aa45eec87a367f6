"""Tests that convex polyhedra are found again from their masks, and that other bodies are not taken for some."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from support.silhouettes import sightings_of, traced

from datagen.data.meshes import Mesh, check_closed, check_mesh, check_solid
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.modelling import ball, deformed, lathe
from datagen.scene.procedural.solids import hull
from model.fit.found import from_state, to_state
from model.fit.kinds import choose_outside
from model.fit.polyhedra import Polyhedron, fit_polyhedron
from model.fit.silhouettes import unexplained
from model.fit.views import rays_near

use_mitsuba()
pytestmark = pytest.mark.usefixtures("coarse_hulls")
UP = np.array([0.0, 0.0, 1.0])


def stone(corners: int) -> np.ndarray:
    """Corners of a faceted stone of 10 cm that stands on its lowest one."""
    points = np.random.default_rng(3).normal(size=(corners, 3))
    points *= np.array([0.05, 0.04, 0.04]) / np.linalg.norm(points, axis=1, keepdims=True)
    return points - [0, 0, points[:, 2].min()]


def rounded(corners: np.ndarray) -> Mesh:
    """Such a stone as a visual hull shows it: its edges and corners are worn, its facets bumpy."""
    solid = ConvexHull(corners)
    points = trimesh.sample.sample_surface(trimesh.Trimesh(corners, solid.simplices), 2000, seed=0)[0]
    points += np.random.default_rng(0).normal(size=points.shape) * 0.0005
    inside = (points @ solid.equations[:, :3].T + solid.equations[:, 3]) < -0.001
    return hull(points[inside.sum(axis=1) >= len(solid.equations) - 1])


def normal_error_deg(polyhedron: Polyhedron, corners: np.ndarray) -> float:
    """Median over the true surface of the angle to the nearest facet that was found."""
    true = ConvexHull(corners)
    mesh = trimesh.Trimesh(polyhedron.surface.vertices, polyhedron.surface.faces, process=False)
    cosine = (true.equations[:, :3] @ mesh.face_normals.T).max(axis=1)
    areas = trimesh.Trimesh(corners, true.simplices, process=False).area_faces
    order = np.argsort(cosine)[::-1]
    middle = order[np.searchsorted(np.cumsum(areas[order]), areas.sum() / 2)]
    return float(np.degrees(np.arccos(min(1.0, cosine[middle]))))


@pytest.mark.parametrize(
    ("wrong", "most_deg"), [(0.0, 1.0), pytest.param(0.02, 2.0, marks=pytest.mark.full, id="masks wrong in places")]
)
def test_a_stone_is_found_with_its_corners_and_facets(wrong: float, most_deg: float) -> None:
    corners = stone(10)
    sightings = sightings_of(traced(hull(corners)), views=24, wrong=wrong)
    polyhedron = fit_polyhedron(rays_near(sightings, 1), rounded(corners), UP, 0.0)
    assert polyhedron is not None
    assert abs(polyhedron.num_corners - len(ConvexHull(corners).vertices)) <= 2
    assert normal_error_deg(polyhedron, corners) < most_deg
    assert polyhedron.surface.vertices[:, 2].min() > -1e-6  # A pixel is 6 mm wide.
    check_mesh(polyhedron.surface, where="stone")
    check_closed(polyhedron.surface, where="stone")
    check_solid(polyhedron.surface, where="stone")


def test_a_body_that_is_not_convex_is_none() -> None:
    waisted = lathe([(0, 0.001), (0.04, 0.001), (0.02, 0.05), (0.04, 0.1), (0, 0.1)])
    assert fit_polyhedron(rays_near(sightings_of(traced(waisted), views=8), 1), waisted, UP, 0.0) is None


@pytest.mark.full
def test_a_round_body_stays_a_hull() -> None:
    def ellipsoid(p: np.ndarray) -> np.ndarray:
        return p * [0.05, 0.035, 0.04] + [0, 0, 0.041]

    sightings = sightings_of(traced(deformed(ball(1.0), ellipsoid)), views=24)
    outside = choose_outside(sightings, 1, UP, mask_errors=0, stands_on=lambda point, reach: 0.0)
    assert outside.glass.kind == "hull"


@pytest.mark.full
def test_a_stone_is_no_hull_of_any_shape() -> None:
    corners = stone(12)
    sightings = sightings_of(traced(hull(corners)), views=24)
    outside = choose_outside(sightings, 1, UP, mask_errors=0, stands_on=lambda point, reach: 0.0)
    assert isinstance(outside.glass, Polyhedron)
    assert outside.unexplained == pytest.approx(unexplained(outside.glass.mesh(), rays_near(sightings, 1)))
    again = from_state(to_state(outside.glass))
    assert np.array_equal(again.mesh().vertices, outside.glass.mesh().vertices)
    assert again.kind == f"polyhedron with {again.num_corners} corners"
