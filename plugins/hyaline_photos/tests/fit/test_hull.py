"""Solids of any shape are found again from their masks."""

import dataclasses

import numpy as np
import pytest
from support.silhouettes import Meets, ball, block, cylinder, either, sightings_of

from datagen.data.meshes import check_mesh
from datagen.data.queries import check_closed
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.atlas import coverage
from datagen.scene.modelling import moved, rounded_box
from hyaline_photos.fit import hull
from hyaline_photos.fit.hull import carve
from hyaline_photos.fit.views import rays_near, unexplained

UP = np.array([0.0, 0.0, 1.0])
HANDLE = block((0.045, 0, 0.05), (0.02, 0.006, 0.006), np.eye(3))


@pytest.fixture(autouse=True)
def coarse(coarse_hulls: None, monkeypatch: pytest.MonkeyPatch) -> None:
    use_mitsuba()
    monkeypatch.setattr(hull, "SMOOTH", (0.7,))


def test_a_ball_is_found_to_a_tenth_of_a_pixel_from_masks_that_are_wrong_in_places() -> None:
    wrong = 0.02
    masks = sightings_of(ball((0, 0, 0.05), 0.04), wrong=wrong)
    shape = carve(masks, 1, UP, 0.0)
    away = np.abs(np.linalg.norm(shape.surface.vertices - [0, 0, 0.05], axis=1) - 0.04)
    assert away.mean() < 0.0008  # A pixel is 6 mm wide.
    assert np.quantile(away, 0.99) < 0.003
    assert unexplained(shape.surface, rays_near(masks, 1)) < 0.01 + 2 * wrong


@pytest.mark.parametrize(
    ("meets", "scale"),
    [
        (ball((0, 0, 0.05), 0.04), 1.5),
        pytest.param(block((0, 0, 0.05), (0.04, 0.03, 0.04), np.eye(3)), 0.7, marks=pytest.mark.full),
    ],
)
def test_a_round_body_is_smoothed_further_than_edges_allow(
    meets: Meets, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    masks = sightings_of(meets, views=20, size=48)
    shapes = []
    for scales in ((0.7, 1.5), (scale,)):
        monkeypatch.setattr(hull, "SMOOTH", scales)
        shapes.append(carve(masks, 1, UP).surface.vertices)
    assert np.array_equal(*shapes)


def test_a_handle_is_found_on_its_side_in_a_closed_mesh_with_texels_of_its_own_everywhere() -> None:
    mesh = carve(sightings_of(either(cylinder(0.03, 0, 0.09), HANDLE)), 1, UP, 0.0).unwrapped().mesh()
    check_mesh(mesh, where="hull")
    check_closed(mesh, where="hull")
    assert coverage(mesh, 1024).max() == 1
    assert mesh.vertices[:, 0].max() == pytest.approx(0.065, abs=0.0025)
    assert mesh.vertices[:, 0].min() == pytest.approx(-0.03, abs=0.0015)
    beside = mesh.vertices[mesh.vertices[:, 0] > 0.05]
    assert np.quantile(np.abs(beside[:, 1]), 0.9) == pytest.approx(0.006, abs=0.0025)


def test_a_place_that_another_object_hides_stays() -> None:
    seen = sightings_of(ball((0, 0, 0.05), 0.04))
    behind = seen.first.copy()
    # In a third of the views, something unknown covers the ball's right half.
    behind[::3, :, 32:] = 2
    shape = carve(dataclasses.replace(seen, first=behind, unknown=(1, 2)), 1, UP, 0.0)
    away = np.abs(np.linalg.norm(shape.surface.vertices - [0, 0, 0.05], axis=1) - 0.04)
    assert away.mean() < 0.0006


def test_masks_without_a_point_in_common_are_an_error() -> None:
    seen = sightings_of(ball((0, 0, 0.05), 0.02), views=20)
    seen.first[::2] = np.roll(seen.first[::2], 12, axis=2)
    with pytest.raises(HyalineError, match="no point in common"):
        carve(seen, 1, UP, None)


@pytest.mark.parametrize(("size", "low", "high"), [(0.06, 0, 0.005), (0.05, 0.1, 1), (0.07, 0.1, 1)])
def test_what_a_shape_leaves_unexplained_counts_misses_and_false_hits(size: float, low: float, high: float) -> None:
    rays = rays_near(sightings_of(block((0, 0, 0.05), (0.03, 0.03, 0.03), np.eye(3)), views=20), 1)
    box = moved(rounded_box((size, size, size), bevel=1e-4), (0, 0, 0.05))
    assert low <= unexplained(box, rays) < high
