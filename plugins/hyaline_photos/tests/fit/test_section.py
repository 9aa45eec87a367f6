"""Tests sections that are polygons with rounded corners against superellipses and polygons in closed form."""

import numpy as np
import pytest

from hyaline_photos.fit.section import MOST_SHARPNESS, SHARP, Section, guess_section

ANGLES = 2 * np.pi * np.arange(72) / 72


@pytest.mark.parametrize("power", [2.0, 3.7, 20.0])
def test_four_sides_are_a_superellipse(power: float) -> None:
    turn = 0.3
    away = ANGLES - turn
    superellipse = (np.abs(np.cos(away)) ** power + np.abs(np.sin(away)) ** power) ** (-1 / power)
    assert Section(sides=4, sharpness=power, turn=turn).factors(ANGLES) == pytest.approx(superellipse)


@pytest.mark.parametrize("sides", [3, 5, 8])
def test_the_sharpest_round_sections_are_polygons_with_small_corners(sides: int) -> None:
    section = Section(sides=sides, sharpness=MOST_SHARPNESS, turn=0.0)
    step = 2 * np.pi / sides
    polygon = 1 / np.cos((ANGLES + step / 2) % step - step / 2)
    assert section.factors(ANGLES) == pytest.approx(polygon, rel=0.02)
    assert section.factors(ANGLES).max() > 1 + 0.9 * (polygon.max() - 1)


def test_a_sharp_polygon_has_flat_sides_whose_columns_face_away_from_them() -> None:
    section = Section(sides=5, sharpness=SHARP, turn=0.3)
    columns = section.columns(96)
    normals = 0.3 + 2 * np.pi / 5 * np.arange(5)
    far = columns.factors * np.cos(columns.angles - normals[:, None])
    assert far.max(axis=0) == pytest.approx(1)
    assert section.factors(columns.angles) == pytest.approx(columns.factors)
    facing = columns.angles - np.arctan2(columns.slopes, columns.factors)
    assert np.cos(facing - normals[:, None]).max(axis=0) == pytest.approx(1)


def test_slopes_are_derivatives_and_places_on_the_surface_have_its_outlines_radius() -> None:
    section, step = Section(sides=5, sharpness=9.0, turn=1.1), 1e-6
    differences = (section.factors(ANGLES + step) - section.factors(ANGLES - step)) / (2 * step)
    assert section.slopes(ANGLES) == pytest.approx(differences, abs=1e-7)
    radii = 0.03 * section.factors(ANGLES)
    found = section.outline_radii(radii * np.cos(ANGLES), radii * np.sin(ANGLES))
    assert found == pytest.approx(0.03, rel=1e-3)
    assert section.middles().tolist() == [[0, 0]]


def test_oblong_sections_of_all_radii_are_as_far_apart_on_all_sides() -> None:
    section = Section(sides=4, sharpness=MOST_SHARPNESS, turn=0.3, stretch=0.02)
    along, across = np.array([np.cos(0.3), np.sin(0.3)]), np.array([-np.sin(0.3), np.cos(0.3)])
    for place in (0.05 * along, -0.05 * along, 0.03 * across, 0.015 * along - 0.03 * across):
        assert section.outline_radii(*place[:, None]) == pytest.approx(0.03, rel=1e-3)
    assert section.outline_radii(*(0.01 * along)[:, None]) == pytest.approx(0, abs=1e-9)
    assert section.middles()[1:] == pytest.approx(np.stack([-0.02 * along, 0.02 * along]))


def test_points_are_dense_where_the_section_turns() -> None:
    section = Section(sides=4, sharpness=30.0, turn=0.0)
    columns = section.columns(96)
    assert not columns.moved.any()
    angles = columns.angles
    gaps = np.diff(angles)
    assert (gaps > 0).all()
    assert angles[-1] < 2 * np.pi
    at_corner = np.abs((angles[:-1] + gaps / 2) % (np.pi / 2) - np.pi / 4) < 0.05
    assert gaps[at_corner].mean() < 0.5 * gaps[~at_corner].mean()


@pytest.mark.parametrize(
    "section",
    [
        Section(sides=4, sharpness=4.0, turn=0.5),
        Section(sides=3, sharpness=25.0, turn=-0.4),
        Section(sides=6, sharpness=40.0, turn=0.1),
    ],
    ids=lambda section: f"{section.sides}-sided",
)
def test_a_polygon_is_found_from_its_radii(section: Section) -> None:
    noise = 1 + 0.004 * np.random.default_rng(0).normal(size=len(ANGLES))
    found = guess_section(ANGLES, 0.03 * section.factors(ANGLES) * noise)
    assert found is not None
    assert found.sides == section.sides
    away = (found.turn - section.turn + np.pi / section.sides) % (2 * np.pi / section.sides) - np.pi / section.sides
    assert away == pytest.approx(0, abs=0.01)
    assert found.factors(ANGLES) == pytest.approx(section.factors(ANGLES), rel=0.01)


@pytest.mark.parametrize(
    "radii",
    [
        np.full(72, 0.03),
        0.03 * (1 + 0.1 * np.cos(ANGLES)),
        0.03 * (1 + 0.3 * (np.abs(ANGLES - 2) < 0.2)),
        0.03 * (1 + 0.15 * np.cos(2 * ANGLES)),
    ],
    ids=["circle", "beside the axis", "handle", "oval"],
)
def test_what_is_no_polygon_is_not_taken_for_one(radii: np.ndarray) -> None:
    assert guess_section(ANGLES, radii) is None
