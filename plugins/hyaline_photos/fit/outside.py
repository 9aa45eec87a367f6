"""The visual hull of revolution from masks, in closed form, and the outlines of vessels, solids and balls from it.

A ray that misses an object bounds it: where the ray passes height z of the axis, the object's radius there is at most
the ray's distance from the axis. The least bound of all rays is the visual hull of revolution, without voxels.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy import interpolate, optimize

from datagen.disk.errors import HyalineError
from hyaline_photos.fit.shapes import OUTSIDE, POINTS, Axis, Revolution, evenly, spread
from hyaline_photos.fit.views import NearRays

FINE = 501
"""Heights of a profile."""
WORTH_A_TILT = 0.003
"""Share of a mask's rays that a tilted axis has to explain beyond those that an upright one does."""
COARSE, COARSE_RAYS = 129, 20_000
"""Heights, and most rays, while the axis is searched."""
REACH = 1.1
"""Half the length of axis on which an object is looked for, in parts of its radius."""
INSIDE_RAYS = 20_000
"""Most rays through a mask's inside."""
RAYS_AT_ONCE = 16_384
"""Rays that are looked at together at all heights, which takes 0.3 GB."""
WRONG_RAYS = 0.003
"""Share of the rays that meet an object that need not be explained where masks may be wrong."""
STRAY_RAYS = 0.0005
"""The same for exact masks: without it, a few rays over a rim lengthened a wine glass by a spike of 4 mm."""
THREAD = 0.1
"""Mean radius of a thread, over its length, at most."""
LEAST_BESIDE = 0.02
"""Least share of the rays at edges that miss the object; usually about half of them do."""
FAR = 0.5
"""Cap on the distance between a ray and a hull, relative to the object's size; it limits the effect of wrong mask
pixels."""
SLOW = 1e-4
"""Cosine of rays that are taken to be perpendicular to the axis."""
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Hull:
    """The visual hull of revolution about an axis."""

    axis: Axis
    heights: Float64[np.ndarray, " height"]
    """Metres along the axis from its point, evenly spaced."""
    radii: Float64[np.ndarray, " height"]
    """Metres; 0 beyond the ends."""
    bounds: Float64[np.ndarray, " height"]
    """The same without ends: infinite where no ray bounds it."""
    unexplained: float
    """Share of the mask's rays that miss the hull."""
    is_exact: bool
    """No mask is wrong: it is nowhere too narrow."""


def find_hull(rays: NearRays, up: Float64[np.ndarray, "3"], *, order: int) -> Hull:
    """Finds the axis whose hull of revolution explains the masks best, beginning with an upright one.

    A wrong axis makes the hull too thin for rays that meet the object: the search minimises by how much. A tilted axis
    has to explain more of the mask than an upright one.

    Args:
        order: how many rays at each height may miss the object by mistake.

    Raises:
        HyalineError: the masks do not show its edge.
    """
    center, radius = find_center(rays)
    edge = rays.at_edges().thinned(COARSE_RAYS)
    if (~edge.hits).sum() <= max(order, LEAST_BESIDE * len(edge.hits)) or not edge.hits.any():
        raise HyalineError("masks do not show its shape: hardly any ray passes beside it")
    upright, coarse = Axis(point=center, direction=up), np.linspace(-radius, radius, COARSE)
    heights = np.linspace(-REACH * radius, REACH * radius, FINE)
    x, hulls = np.zeros(4), []
    for steps, most in (([0.1, 0.1], 60), ([0.02, 0.02, 0.05, 0.05], 150)):

        def lack(first: np.ndarray) -> float:
            shift, tilt = np.append(first, np.zeros(4 - len(first))).reshape(2, 2)
            return _lack(edge, upright.moved(tilt, shift * radius), coarse, order=order) / radius

        simplex = x[: len(steps)] + np.concatenate([np.zeros((1, len(steps))), np.diag(steps)])
        options = {"xatol": 2e-4, "fatol": 1e-7, "maxfev": most, "initial_simplex": simplex}
        found = optimize.minimize(lack, simplex[0], method="Nelder-Mead", options=options).x
        x = np.append(found, np.zeros(4 - len(found)))
        hulls.append(hull_about(rays, upright.moved(x[2:], x[:2] * radius), heights, order=order))
    return min(hulls, key=lambda hull: hull.unexplained + (hull is hulls[1]) * WORTH_A_TILT)


def hull_about(rays: NearRays, axis: Axis, heights: Float64[np.ndarray, " height"], *, order: int) -> Hull:
    """The hull about a known axis, no longer than the rays that meet the object need it to be."""
    num_hits, is_inside = int(rays.hits.sum()), rays.hits & ~rays.is_edge
    # What explains the edge of a mask mostly explains its inside: of many rays there, some stand for all.
    each = max(1, -(-int(is_inside.sum()) // INSIDE_RAYS))
    rays = rays.only(~is_inside | (np.cumsum(is_inside) % each == 0))
    weight = np.where(rays.is_edge, 1, each)[rays.hits]
    parts = [rays.only(slice(at, at + RAYS_AT_ONCE)) for at in range(0, len(rays.hits), RAYS_AT_ONCE)]
    nearest = np.zeros((0, len(heights)))
    for part in parts:
        nearest = np.concatenate([nearest, crossings(part, axis, heights)[~part.hits]])
        nearest = np.partition(nearest, order, axis=0)[: order + 1] if len(nearest) > order + 1 else nearest
    bounds = _bounds(nearest, heights, order=order)
    radii = np.where(np.isfinite(bounds), bounds, 0)
    spans = [_span_inside(part, axis, heights, radii) for part in parts]
    explained, lowest, highest = (np.concatenate(each) for each in zip(*spans, strict=True))
    kept, unexplained = np.zeros_like(radii), 1.0
    if explained.any():
        lowest, highest = lowest[explained], highest[explained]
        # Some rays miss: where masks may be wrong, and where a rim is rounder than the spacing of heights.
        loose, last = round(WRONG_RAYS * num_hits), len(heights) - 1
        step = float(heights[1] - heights[0])
        at_top, at_bottom = (loose, loose) if order else (round(STRAY_RAYS * num_hits), 0)
        top = last - _end(radii[::-1], last - lowest, spare=at_top, loose=loose, step=step)
        bottom = _end(radii, highest, spare=at_bottom, loose=loose, step=step)
        kept[bottom : top + 1] = radii[bottom : top + 1]
        unexplained = float(weight[~explained].sum() / num_hits)
    return Hull(axis=axis, heights=heights, radii=kept, bounds=bounds, unexplained=unexplained, is_exact=order == 0)


def _span_inside(
    rays: NearRays, axis: Axis, heights: np.ndarray, radii: Float64[np.ndarray, " height"]
) -> tuple[Bool[np.ndarray, " hit"], Int[np.ndarray, " hit"], Int[np.ndarray, " hit"]]:
    """Which of the rays that meet the object are inside these radii somewhere, and their first and last place there."""
    inside = crossings(rays, axis, heights)[rays.hits] <= radii
    place, least = _closest(rays, axis, heights)
    inside[np.arange(len(inside)), place] |= least <= radii[place]
    return np.asarray(inside.any(axis=1)), inside.argmax(axis=1), len(heights) - 1 - inside[:, ::-1].argmax(axis=1)


def _end(
    radii: Float64[np.ndarray, " height"], needed: Int[np.ndarray, " ray"], *, spare: int, loose: int, step: float
) -> int:
    """Where a hull ends: at most `spare` rays meet it only before that place. A thread along the axis is cut off if at
    most `loose` rays meet nothing else: they passed over the edge of a flat end.

    Args:
        radii: at heights that are `step` metres apart.
        needed: the last place at which each ray is inside.
    """
    ends = np.sort(needed)[min(spare, len(needed) - 1) : loose + 1]
    first, radii = int(ends[0]), radii / step
    threads = [int(place) for place in ends if radii[first:place].sum() < THREAD * (place - first) ** 2]
    return max(threads, default=first)


def crossings(rays: NearRays, axis: Axis, heights: Float64[np.ndarray, " height"]) -> Float[np.ndarray, "ray height"]:
    """Metres from the axis where each ray passes these heights; infinite behind `reach` or the camera."""
    along_o, across_o = along_and_across(rays.origins - axis.point, axis)
    along_d, across_d = along_and_across(rays.directions, axis)
    t = (heights - along_o[:, None]) / np.where(np.abs(along_d) < SLOW, SLOW, along_d)[:, None]
    # |a + t b|^2 by its three dot products, instead of a vector for each ray and height.
    aa, ab, bb = (
        np.einsum("rc,rc->r", x, y) for x, y in ((across_o, across_o), (across_o, across_d), (across_d, across_d))
    )
    rho = np.sqrt(np.maximum(aa[:, None] + t * (2 * ab[:, None] + t * bb[:, None]), 0))
    return np.where((t > 0) & (t < rays.reach[:, None]), rho, np.inf)


def along_and_across(
    vectors: Float64[np.ndarray, "ray 3"], axis: Axis
) -> tuple[Float64[np.ndarray, " ray"], Float64[np.ndarray, "ray 3"]]:
    """The component of vectors along an axis, and the rest."""
    along = vectors @ axis.direction
    return along, vectors - along[:, None] * axis.direction


def _bounds(
    rho: Float[np.ndarray, "miss height"], heights: Float64[np.ndarray, " height"], *, order: int
) -> Float[np.ndarray, " height"]:
    """The least distance from the axis of the rays that miss the object, but for `order` of them.

    Infinite beyond the search range, a ball around the axis's point. Below a table's surface the only rays are distant
    ones, and a wine glass on it was 35 cm wide just below its foot.
    """
    least = np.partition(rho, order, axis=0)[order]
    reach = np.abs(heights).max()
    return np.where(least**2 + heights**2 <= reach**2, least, np.inf)


def _closest(
    rays: NearRays, axis: Axis, heights: Float64[np.ndarray, " height"]
) -> tuple[Int[np.ndarray, " hit"], Float64[np.ndarray, " hit"]]:
    """Where rays that meet the object come closest to the axis: the place of the nearest height, and the distance.

    A flat ray may pass through the object between two heights.
    """
    along_o, across_o = along_and_across(rays.origins[rays.hits] - axis.point, axis)
    along_d, across_d = along_and_across(rays.directions[rays.hits], axis)
    t = -np.einsum("rc,rc->r", across_o, across_d)
    t /= np.maximum(np.einsum("rc,rc->r", across_d, across_d), SLOW)
    place = np.rint((along_o + t * along_d - heights[0]) / (heights[1] - heights[0])).astype(int)
    is_on = (place >= 0) & (place < len(heights)) & (t > 0) & (t < rays.reach[rays.hits])
    least = np.where(is_on, np.linalg.norm(across_o + t[:, None] * across_d, axis=1), np.inf)
    return np.where(is_on, place, 0), least


def _lack(rays: NearRays, axis: Axis, heights: np.ndarray, *, order: int) -> float:
    """Mean distance in metres by which rays that meet the object miss its hull."""
    rho = crossings(rays, axis, heights)
    radii = _bounds(rho[~rays.hits], heights, order=order)
    radii = np.where(np.isfinite(radii), radii, 0)
    place, least = _closest(rays, axis, heights)
    gaps = np.minimum((rho[rays.hits] - radii).min(axis=1), least - radii[place]).clip(0)
    return float(np.minimum(gaps, FAR * heights[-1]).mean())


def find_center(rays: NearRays) -> tuple[Float64[np.ndarray, "3"], float]:
    """The point nearest to the rays through the middles of the masks, and how far the object reaches from it."""
    middles = []
    for view in np.unique(rays.view[rays.hits]):
        these = rays.hits & (rays.view == view)
        direction = rays.directions[these].mean(axis=0)
        middles.append((rays.origins[these][0], direction / np.linalg.norm(direction)))
    o, d = (np.stack(column) for column in zip(*middles, strict=True))
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    center = np.linalg.solve(across.sum(axis=0), np.einsum("vij,vj->i", across, o))
    to_center = center - rays.origins[rays.hits]
    far = np.linalg.norm(np.cross(to_center, rays.directions[rays.hits]), axis=1)
    return center, float(np.quantile(far, 0.999)) * 1.05


# Outlines


def find_outside(hull: Hull, support: float | None) -> Revolution | None:
    """Extracts the outside of a vessel from its hull, or of a solid with a flat top; None if the hull is too short.

    Args:
        support: height along the axis of the known surface below it, if there is one.
    """
    heights, radii = _inside(hull)
    if len(heights) < LEAST_HEIGHTS:
        return None
    size, bottom = radii.max(), heights[0] if support is None else support
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
    heights, radii = _inside(hull)
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
    line = evenly(side, POINTS - END * (2 - closes_below - closes_above))
    if not closes_below:
        line = np.concatenate([np.linspace((0.0, low), side[0], END, endpoint=False), line])
    if not closes_above:
        line = np.concatenate([line, np.linspace((0.0, high), side[-1], END, endpoint=False)[::-1]])
    line[[0, -1], 0] = 0.0
    return Revolution(axis=hull.axis, outside=evenly(line, OUTSIDE), solid=line)


def find_ball(hull: Hull) -> Revolution | None:
    """The ball that a hull may be; None if it is not round. Its ends, which masks show badly, don't count."""
    heights, radii = _inside(hull)
    if not len(heights):
        return None
    middle, radius = float(heights.mean()), float(radii.max())
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


def _inside(hull: Hull) -> tuple[Float64[np.ndarray, " height"], Float64[np.ndarray, " height"]]:
    """Heights between the ends of a hull, and its radii there."""
    inside = hull.radii > 0
    return hull.heights[inside], hull.radii[inside]
