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
from hyaline_photos.fit.views import MOST_OVERRULED, NearRays, outvoted

FINE = 501
"""Heights of a profile."""
WORTH_A_TILT = 0.003
"""Share of a mask's rays that a tilted axis has to explain beyond those that an upright one does."""
COARSE, COARSE_RAYS = 129, 20_000
"""Heights, and most rays, while the axis is searched."""
VOTING, VOTING_RAYS = 65, 8000
"""The same while views are compared."""
PIXELS_OFF = 1.5
"""Tolerance of a mask's edge in pixels while views are compared."""
FAR_AWAY = 1e3
"""Metres that stand for infinity."""
REACH = 1.1
"""Half the length of axis on which an object is looked for, in parts of its radius."""
INSIDE_RAYS = 20_000
"""Most rays through a mask's inside."""
RAYS_AT_ONCE = 16_384
"""Rays that are looked at together at all heights, which takes 0.3 GB."""
WRONG_RAYS = 0.003
"""Share of the rays that meet an object, of each view, that need not be explained where masks may be wrong."""
TOO_LONG = 0.3
"""Share of the views whose masks may go on beyond an object's end. It is not small: nearly all views show an end, and
the largest errors of many masks are large."""
STRAY_RAYS = 0.0005
"""The same for exact masks: without it, a few rays over a rim lengthened a wine glass by a spike of 4 mm."""
THREAD = 0.1
"""Mean radius of a thread, over its length, at most."""
LEAST_BESIDE = 0.02
"""Least share of the rays at edges that miss the object; usually about half of them do."""
FAR = 0.5
"""Cap on the distance between a ray and a hull, relative to the object's size; against wrong mask pixels."""
TALL, MOST_SHORTENED = 0.1, 0.3
"""Share of the views that may show less of an object's reach, and the least factor by which a view shortens it."""
SLOW = 1e-4
"""Cosine of rays that are taken to be perpendicular to the axis."""
ROUND = 0.015
"""By which the hull of a ball may differ from a sphere (root mean square). From here in parts of the largest radius."""
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
        order: how many views may be wrong about each height: something may hide the object there.

    Raises:
        HyalineError: the masks do not show its edge.
    """
    center, radius = find_center(rays, up)
    edge = rays.at_edges().thinned(COARSE_RAYS)
    if (~edge.hits).sum() <= LEAST_BESIDE * len(edge.hits) or not edge.hits.any():
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


def overruled_about(rays: NearRays, up: Float64[np.ndarray, "3"]) -> Int[np.ndarray, " overruled"]:
    """Views whose masks lack parts that an upright object of revolution has by the other views (`outvoted`).

    Raises:
        HyalineError: the masks do not show its edge.
    """
    center, radius = find_center(rays, up)
    edge = rays.at_edges().thinned(VOTING_RAYS)
    if edge.hits.all() or not edge.hits.any():
        raise HyalineError("masks do not show its shape: hardly any ray passes beside it")
    heights, order = np.linspace(-radius, radius, VOTING), int(MOST_OVERRULED * len(np.unique(edge.view)))
    upright = Axis(point=center, direction=up)

    def lack(shift: np.ndarray) -> float:
        return _lack(edge, upright.moved(np.zeros(2), shift * radius), heights, order=order) / radius

    simplex = np.concatenate([np.zeros((1, 2)), 0.1 * np.eye(2)])
    options = {"xatol": 1e-3, "fatol": 1e-6, "maxfev": 40, "initial_simplex": simplex}
    shift = optimize.minimize(lack, simplex[0], method="Nelder-Mead", options=options).x
    rho = crossings(edge, upright.moved(np.zeros(2), shift * radius), heights)
    bounds, views = _least_by_view(rho[~edge.hits], edge.view[~edge.hits])
    bounds = _down_to_foot(bounds, order=order)
    bounds[:, ~np.isfinite(_bounds(bounds, heights, order=order))] = 0
    # A pixel's width, by which a mask's edge may be wrong.
    far = float(np.median(np.linalg.norm(edge.origins - center, axis=1)))
    met = np.minimum(rho[edge.hits], FAR_AWAY) - PIXELS_OFF * edge.pixel_angle * far
    return views[outvoted((bounds[:, None] - met[: VOTING_RAYS // 4]).astype(np.float32))]


def hull_about(rays: NearRays, axis: Axis, heights: Float64[np.ndarray, " height"], *, order: int) -> Hull:
    """The hull about a known axis, no longer than the rays that meet the object need it to be."""
    num_hits, is_inside = int(rays.hits.sum()), rays.hits & ~rays.is_edge
    # What explains the edge of a mask mostly explains its inside: of many rays there, some stand for all.
    each = max(1, -(-int(is_inside.sum()) // INSIDE_RAYS))
    rays = rays.only(~is_inside | (np.cumsum(is_inside) % each == 0))
    weight = np.where(rays.is_edge, 1, each)[rays.hits]
    parts = [rays.only(slice(at, at + RAYS_AT_ONCE)) for at in range(0, len(rays.hits), RAYS_AT_ONCE)]
    nearest, views = np.zeros((0, len(heights))), np.zeros(0, int)
    for part in parts:
        nearest = np.concatenate([nearest, crossings(part, axis, heights)[~part.hits]])
        nearest, views = _least_by_view(nearest, np.concatenate([views, part.view[~part.hits]]))
    bounds = _bounds(nearest, heights, order=order)
    radii = np.nan_to_num(_bounds(_down_to_foot(nearest, order=order), heights, order=order), posinf=0)
    spans = [_span_inside(part, axis, heights, radii) for part in parts]
    explained, lowest, highest = (np.concatenate(each) for each in zip(*spans, strict=True))
    kept, unexplained = np.zeros_like(radii), 1.0
    if explained.any():
        lowest, highest, view = lowest[explained], highest[explained], rays.view[rays.hits][explained]
        last = len(heights) - 1
        if order:
            top, bottom = last - _end_by_views(last - lowest, view), _end_by_views(highest, view)
        else:
            # Some rays miss where a rim is rounder than the spacing of heights.
            loose, step = round(WRONG_RAYS * num_hits), float(heights[1] - heights[0])
            spare = round(STRAY_RAYS * num_hits)
            top = last - _end(radii[::-1], last - lowest, spare=spare, loose=loose, step=step)
            bottom = _end(radii, highest, spare=0, loose=loose, step=step)
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
    first = inside.argmax(axis=1)
    last = len(heights) - 1 - inside[:, ::-1].argmax(axis=1)
    return np.asarray(inside.any(axis=1)), first, last


def _end(
    radii: Float64[np.ndarray, " height"], needed: Int[np.ndarray, " ray"], *, spare: int, loose: int, step: float
) -> int:
    """Where a hull of exact masks ends: at most `spare` rays meet it only before that place. A thread along the axis is
    cut off if at most `loose` rays meet nothing else: they passed over the edge of a flat end.

    Args:
        radii: at heights that are `step` metres apart.
        needed: the last place at which each ray is inside.
    """
    ends = np.sort(needed)[min(spare, len(needed) - 1) : loose + 1]
    first, radii = int(ends[0]), radii / step
    threads = [int(place) for place in ends if radii[first:place].sum() < THREAD * (place - first) ** 2]
    return max(threads, default=first)


def _end_by_views(needed: Int[np.ndarray, " ray"], view: Int[np.ndarray, " ray"]) -> int:
    """The same where masks may be wrong, some of them by too much at that end: views vote."""
    ends = [np.quantile(needed[view == each], WRONG_RAYS, method="lower") for each in np.unique(view)]
    return int(np.quantile(ends, TOO_LONG, method="lower"))


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
    rho: Float[np.ndarray, "view height"], heights: Float64[np.ndarray, " height"], *, order: int
) -> Float[np.ndarray, " height"]:
    """The least distance from the axis of the views' rays that miss the object, but for `order` views.

    Infinite beyond the search range, a ball around the axis's point. Below a table's surface the only rays are distant
    ones, and a wine glass on it was 35 cm wide just below its foot.
    """
    order = min(order, len(rho) - 1)
    least = np.partition(rho, order, axis=0)[order]
    reach = np.abs(heights).max()
    return np.where(least**2 + heights**2 <= reach**2, least, np.inf)


def _down_to_foot(rho: Float[np.ndarray, "view height"], *, order: int) -> Float[np.ndarray, "view height"]:
    """Where masks may be wrong, hardly any ray gets down beside a foot, since known surfaces are `doubted`: below the
    lowest height that half of the views bound, each bounds the object as there.
    """
    if order == 0:
        return rho
    lowest = int((np.isfinite(rho).mean(axis=0) >= 0.5).argmax())
    return np.concatenate([np.repeat(rho[:, [lowest]], lowest, axis=1), rho[:, lowest:]], axis=1)


def _least_by_view(
    rho: Float[np.ndarray, "miss height"], view: Int[np.ndarray, " miss"]
) -> tuple[Float[np.ndarray, "view height"], Int[np.ndarray, " view"]]:
    """The least of each view's rays, which are sorted by views; and these views."""
    starts = np.flatnonzero(np.diff(view, prepend=-1))
    return np.minimum.reduceat(rho, starts, axis=0), view[starts]


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
    nearest = _down_to_foot(_least_by_view(rho[~rays.hits], rays.view[~rays.hits])[0], order=order)
    radii = np.nan_to_num(_bounds(nearest, heights, order=order), posinf=0)
    place, least = _closest(rays, axis, heights)
    gaps = np.minimum((rho[rays.hits] - radii).min(axis=1), least - radii[place]).clip(0)
    return float(np.minimum(gaps, FAR * heights[-1]).mean())


def find_center(rays: NearRays, up: Float[np.ndarray, "3"]) -> tuple[Float64[np.ndarray, "3"], float]:
    """The point nearest to the rays through the middles of the masks, and how far the object reaches from it."""
    hits = rays.only(rays.hits)
    views = [hits.only(hits.view == view) for view in np.unique(hits.view)]
    o = np.stack([each.origins[0] for each in views])
    d = np.stack([each.directions.mean(axis=0) for each in views])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    center = np.linalg.solve(across.sum(axis=0), np.einsum("vij,vj->i", across, o))
    far = [np.linalg.norm(np.cross(center - each.origins, each.directions), axis=1) for each in views]
    # Cameras that look down show an object shorter than it is.
    shown = [np.linalg.norm(np.cross(up, each.directions), axis=1).clip(MOST_SHORTENED) for each in views]
    tall = np.quantile([np.quantile(each / part, 0.999) for each, part in zip(far, shown, strict=True)], TALL)
    return center, 1.05 * float(max(np.quantile(np.concatenate(far), 0.999), tall))


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
