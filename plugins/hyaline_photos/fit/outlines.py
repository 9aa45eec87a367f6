"""Outlines of vessels, solids and balls from visual hulls of revolution."""

import numpy as np
from scipy import interpolate

from hyaline_photos.fit.lathe import evenly, spread
from hyaline_photos.fit.outside import Hull
from hyaline_photos.fit.shapes import OUTSIDE, POINTS, Revolution

ROUND = 0.015
"""By which the hull of a ball may differ from a sphere (root mean square). This and what follows in parts of the
largest radius."""

RIM_LEFT_OUT = 0.08
"""Below the top, where a hull follows the rim's rounding instead of the side."""

FOOT_LEFT_OUT = 0.02
"""Above the bottom."""

END_LEFT_OUT = 0.01
"""At both ends of a solid."""

MOST_CAP = 0.1
"""How far the poles of a solid may be beyond what masks show."""

LEAST_CAP = 0.02
"""How far below the support the lower pole may be; a solid whose pole is lower is flat there."""

BELT = 0.7
"""Half the height of the belt of a ball to which its circle is fitted."""

ROUNDS = 5
"""Iterations that centre the belt on the ball."""

LEAST_HEIGHTS = 8
"""Fewer do not show an outline."""

NOISE = 0.0003
"""Assumed standard deviation of a solid's radii."""

END = 10
"""Points of a flat end of a solid."""


def find_outside(hull: Hull, support: float | None) -> Revolution | None:
    """Extracts the outside of a vessel from its hull, or of a solid with a flat top; None if the hull is too short.

    Args:
        support: height along the axis of the known surface below it, if there is one.
    """
    inside = hull.radii > 0
    heights, radii = hull.heights[inside], hull.radii[inside]
    if len(heights) < LEAST_HEIGHTS:
        return None
    bottom = heights[0] if support is None else support
    size = radii.max()
    rim = RIM_LEFT_OUT * size
    kept = (heights > bottom + FOOT_LEFT_OUT * size) & (heights < heights[-1] - rim)
    if kept.sum() < LEAST_HEIGHTS:
        return None
    shown = radii[kept]
    high = heights[kept][-1]
    slope = float(np.diff(np.interp([high - 1.5 * rim, high], heights[kept], shown))[0]) / (1.5 * rim)
    along = np.linspace(bottom, heights[-1], 400)
    side = np.interp(along, heights[kept], shown) + slope * np.maximum(along - high, 0)
    line = np.stack([np.maximum(side, 0.01 * size), along], axis=1)
    outside = spread(np.concatenate([[(0, bottom)], line]), OUTSIDE)
    return Revolution(axis=hull.axis, outside=outside)


def find_solid(hull: Hull, support: float | None) -> Revolution | None:
    """Extracts a solid from its hull, which it follows to its ends, where it closes over the axis or is flat.

    Near a pole the squared radius is linear in the height, so a spline of that is continued to 0 beyond the heights
    that masks show well. None if the hull is too short.

    Args:
        support: as for `find_outside`.
    """
    inside = hull.radii > 0
    heights, radii = hull.heights[inside], hull.radii[inside]
    if len(heights) < LEAST_HEIGHTS:
        return None
    size = radii.max()
    kept = (heights > heights[0] + END_LEFT_OUT * size) & (heights < heights[-1] - END_LEFT_OUT * size)
    if kept.sum() < LEAST_HEIGHTS:
        return None
    weights = 1 / (2 * radii[kept] * NOISE * size)
    spline = interpolate.UnivariateSpline(heights[kept], radii[kept] ** 2, w=weights, s=kept.sum())
    first, last = heights[kept][[0, -1]]
    at_first, at_last = np.asarray(spline([first, last])).tolist()
    slope_first, slope_last = np.asarray(spline.derivative()([first, last])).tolist()
    # Where the squared radius reaches 0, if it falls towards the end.
    lower = first - at_first / slope_first if slope_first > 0 else -np.inf
    upper = last - at_last / slope_last if slope_last < 0 else np.inf
    least = heights[0] - MOST_CAP * size if support is None else support - LEAST_CAP * size
    closes_below, closes_above = bool(lower > least), bool(upper < heights[-1] + MOST_CAP * size)
    low = lower if closes_below else heights[0] if support is None else support
    high = upper if closes_above else heights[-1]
    along = (low + high) / 2 - (high - low) / 2 * np.cos(np.linspace(0, np.pi, 400))
    squares = np.asarray(spline(np.clip(along, first, last)))
    squares += np.minimum(along - first, 0) * slope_first + np.maximum(along - last, 0) * slope_last
    side = np.stack([np.sqrt(np.maximum(squares, 0)), along], axis=1)
    pieces = [evenly(side, POINTS - END * (2 - closes_below - closes_above))]
    if closes_below:
        pieces[0][0, 0] = 0.0
    else:
        pieces.insert(0, np.linspace((0.0, low), side[0], END, endpoint=False))
    if closes_above:
        pieces[-1][-1, 0] = 0.0
    else:
        pieces.append(np.linspace((0.0, high), side[-1], END, endpoint=False)[::-1])
    line = np.concatenate(pieces)
    return Revolution(axis=hull.axis, outside=evenly(line, OUTSIDE), solid=line)


def find_ball(hull: Hull) -> Revolution | None:
    """The ball that a hull may be; None if it is not round. Its ends, which masks show badly, don't count."""
    inside = hull.radii > 0
    if not inside.any():
        return None
    middle, radius = float(hull.heights[inside].mean()), float(hull.radii.max())
    heights, radii = hull.heights[inside], hull.radii[inside]
    for _ in range(ROUNDS):
        near = (np.abs(hull.heights - middle) < BELT * radius) & np.isfinite(hull.bounds)
        if near.sum() < LEAST_HEIGHTS:
            return None
        heights, radii = hull.heights[near], hull.bounds[near]
        columns = np.stack([2 * heights, np.ones(len(heights))], axis=1)
        (middle, rest), *_ = np.linalg.lstsq(columns, radii**2 + heights**2)
        radius = float(np.sqrt(max(rest + middle**2, 0)))
    circle = np.sqrt(np.maximum(radius**2 - (heights - middle) ** 2, 0))
    if np.sqrt(np.mean((circle - radii) ** 2)) > ROUND * radius or np.ptp(heights) < BELT * radius:
        return None
    angles = np.linspace(-np.pi / 2, np.pi / 2, OUTSIDE)
    line = np.stack([radius * np.cos(angles).round(9), middle + radius * np.sin(angles)], axis=1)
    return Revolution(axis=hull.axis, outside=line)
