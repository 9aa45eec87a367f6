"""Tests that radii between the rays of both sides are those of the truth, where hulls bulge."""

import dataclasses

import numpy as np
import pytest
from support.silhouettes import sightings_of, traced

from datagen.machine.mitsuba_variant import use_mitsuba
from hyaline_photos.fit.outside import Hull, hull_about
from hyaline_photos.fit.profiles import between_rays
from hyaline_photos.fit.shapes import Axis, Outline, revolved
from hyaline_photos.fit.views import NearRays, rays_near

use_mitsuba()
UP = np.array([0.0, 0.0, 1.0])
OFF = np.array([0.0005, -0.0003, 0.0])
"""By how much the hull's axis is wrong, in metres; a pixel is 6 mm wide."""


def seen(line: Outline, *, wrong: float = 0.0) -> tuple[NearRays, Hull]:
    """The rays around what an outline sweeps about the z axis, and its hull about an axis close by."""
    mesh = revolved(Axis(point=np.zeros(3), direction=UP), line)
    rays = rays_near(sightings_of(traced(mesh), wrong=wrong), 1)
    axis = Axis(point=OFF, direction=UP)
    heights = np.linspace(-0.01, 0.12, 301)
    return rays, hull_about(rays, axis, heights, order=2 if wrong else 0)


def errors(hull: Hull, line: Outline) -> tuple[float, float]:
    """Median error of the radii of the side in metres, and of its slope in degrees; none near the ends."""
    z = hull.heights
    side = (z > 0.02) & (z < 0.085)
    true = np.interp(z, line[:, 1], line[:, 0])
    slopes = np.arctan(np.gradient(hull.radii, z)) - np.arctan(np.gradient(true, z))
    return float(np.median(np.abs(hull.radii - true)[side])), float(np.degrees(np.median(np.abs(slopes[side]))))


CONE = np.array([(0, 0), (0.03, 0), (0.045, 0.1), (0, 0.1)])
ANGLES = np.linspace(-np.pi / 2, np.pi / 2, 200)
EGG = np.stack([0.04 * np.cos(ANGLES), 0.05 + 0.05 * np.sin(ANGLES)], axis=1)
POST = np.array([(0, 0), (0.04, 0), (0.04, 0.035), (0.03, 0.045), (0.03, 0.06), (0.045, 0.075), (0.045, 0.1), (0, 0.1)])


@pytest.mark.parametrize(
    ("line", "most", "most_deg", "most_aside"),
    [(CONE, 0.00006, 0.4, 0.1), (EGG, 0.00006, 1.0, 0.1), (POST, 0.00015, 3.0, 0.15)],
    ids=["cone", "egg", "post"],
)
def test_radii_slopes_and_the_axis_are_true_where_a_hull_bulges(
    line: Outline, most: float, most_deg: float, most_aside: float
) -> None:
    rays, hull = seen(line)
    fitted = between_rays(hull, rays)
    before, (radius_off, slope_off) = errors(hull, line), errors(fitted, line)
    assert radius_off < most < 0.6 * before[0]
    assert slope_off < most_deg < before[1]
    assert np.linalg.norm(fitted.axis.point[:2]) < most_aside * np.linalg.norm(OFF)


def test_wrong_masks_do_not_tear_the_radii_away() -> None:
    rays, hull = seen(CONE, wrong=0.03)
    radius_off, slope_off = errors(between_rays(hull, rays), CONE)
    assert radius_off < 0.0005
    assert slope_off < 1
    z = hull.heights
    tall = dataclasses.replace(hull, radii=np.where((z > 0.098) & (z < 0.106), 0.045, hull.radii))
    assert not between_rays(tall, rays).radii[z > 0.1].any()


def test_a_foot_whose_upper_side_masks_do_not_show_stays_as_it_is() -> None:
    line = [(0, 0), (0.04, 0), (0.04, 0.003), (0.005, 0.006), (0.005, 0.05), (0.03, 0.07), (0.03, 0.1), (0, 0.1)]
    rays, hull = seen(np.array(line))
    fitted = between_rays(hull, rays)
    foot = (hull.heights > 0) & (hull.heights < 0.004)
    assert (fitted.radii[foot] == hull.radii[foot]).all()


def test_a_hull_of_a_few_heights_stays_as_it_is() -> None:
    rays, _ = seen(CONE)
    hull = hull_about(rays, Axis(point=OFF, direction=UP), np.linspace(-0.01, 0.12, 8), order=0)
    assert between_rays(hull, rays) is hull
