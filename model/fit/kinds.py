"""Which kind of shape an object has: the one whose silhouettes differ least from its masks."""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float64

from datagen.disk.errors import HyalineError
from model.fit.boxes import fit_box
from model.fit.handles import with_handles, without_handles
from model.fit.hull import HullShape, carve
from model.fit.outside import Hull, find_ball, find_hull, find_outside, hull_about
from model.fit.shapes import Glass, Revolution
from model.fit.silhouettes import unexplained
from model.fit.views import NearRays, Sightings, rays_near

STANDS = 0.1
"""Largest gap between an object's lowest point, as masks show it, and its support, relative to its radius."""

GAP = 0.01
"""Gap between an object and its support, relative to its radius. Without a gap, rays hit either of the coinciding
surfaces at random."""

StandsOn = Callable[[Float64[np.ndarray, "3"], float], float | None]
"""Height along up of a known surface no farther than this above or below a point; None: there is none."""

GOOD = 0.03
"""Share of edge pixels that a shape may get wrong before other kinds are tried."""

SIMPLER = 0.006
"""Bias towards simpler kinds, as a share of edge pixels: balls over revolutions and boxes, and these over hulls."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Outside:
    """An outside, and how well it explains the masks."""

    glass: Glass
    unexplained: float
    """Share of the rays at the mask's edge that meet the shape and should miss it, or the other way round."""
    complexity: int
    """0: ball, 1: revolution or box, 2: hull."""

    @property
    def cost(self) -> float:
        return self.unexplained + self.complexity * SIMPLER


def choose_outside(
    sightings: Sightings, object_id: int, up: Float64[np.ndarray, "3"], *, mask_errors: int, stands_on: StandsOn
) -> Outside:
    """The outside of one object.

    Raises:
        HyalineError: the masks do not show it.
    """
    rays = rays_near(sightings, object_id)
    hull = find_hull(rays, up, order=mask_errors)
    support = _support(hull, stands_on)
    found = [_judged(rays, *each) for each in _round(hull, up, support)]
    if min((each.unexplained for each in found), default=1.0) > GOOD:
        for each in _others(sightings, object_id, rays, hull, up, support):
            found.append(_judged(rays, *each))
            if found[-1].complexity < 2 and found[-1].unexplained < GOOD:
                break
    if not found:
        raise HyalineError("masks do not show its shape: too few pixels see it, or no point is inside all masks")
    return min(found, key=lambda each: each.cost)


def _judged(rays: NearRays, complexity: int, glass: Glass) -> Outside:
    return Outside(glass=glass, unexplained=unexplained(glass.mesh(), rays), complexity=complexity)


def _round(hull: Hull, up: np.ndarray, support: float | None) -> Iterator[tuple[int, Glass]]:
    """Ball and revolution, with their complexity."""
    ball = find_ball(hull)
    if ball is not None:
        yield 0, ball
    outside = find_outside(hull, _along_axis(hull, up, support))
    if outside is not None:
        yield 1, outside


def _others(
    sightings: Sightings, object_id: int, rays: NearRays, hull: Hull, up: np.ndarray, support: float | None
) -> Iterator[tuple[int, Glass]]:
    """Box, hull of any shape, and vessel with handles, the quickest first."""
    box = fit_box(rays, up, support)
    if box is not None:
        yield 1, box
    try:
        shape = carve(sightings, object_id, up, support)
    except HyalineError:
        return  # Nothing is inside all masks.
    yield 2, shape
    vessel = _vessel_with_handles(rays, hull, shape, up, support)
    if vessel is not None:
        yield 1, vessel


def _vessel_with_handles(
    rays: NearRays, hull: Hull, shape: HullShape, up: np.ndarray, support: float | None
) -> Revolution | None:
    outside = find_outside(hull, _along_axis(hull, up, support))
    if outside is None:
        return None
    beside = without_handles(rays, outside.hollowed(0.08, 0.1, 0.3), shape)
    if not (~beside.hits).any() or not beside.hits.any():
        return None
    bare = find_outside(hull_about(beside, hull.axis, hull.heights, order=0), _along_axis(hull, up, support))
    return None if bare is None else with_handles(bare.hollowed(0.08, 0.1, 0.3), shape)


def _support(hull: Hull, stands_on: StandsOn) -> float | None:
    """Height along `up` of an object's support, plus the gap."""
    if not hull.radii.any():
        return None
    lowest, radius = hull.heights[hull.radii > 0][0], float(hull.radii.max())
    height = stands_on(hull.axis.point + lowest * hull.axis.direction, STANDS * radius)
    return None if height is None else height + GAP * radius


def _along_axis(hull: Hull, up: np.ndarray, support: float | None) -> float | None:
    """A height along `up` as one along the axis."""
    return None if support is None else float((support - hull.axis.point @ up) / (hull.axis.direction @ up))
