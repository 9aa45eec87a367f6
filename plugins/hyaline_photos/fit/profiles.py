"""Radii of a hull of revolution that explain the rays on both sides of a mask's edge.

A visual hull is never narrower than the truth, and between two heights at which rays touch the glass it bulges. The
rays that meet the glass bound it from inside. Between both, the radii are those whose squares have the fewest jumps of
curvature: about an axis, the squared radius of a ball, a cone, a cylinder or any other quadric is a parabola.
"""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy import ndimage, sparse

from hyaline_photos.fit.outside import PIXELS_OFF, Hull, along_and_across
from hyaline_photos.fit.shapes import Axis, perpendicular
from hyaline_photos.fit.views import NearRays, closest, misfits, pull

SOFTNESS, SOFTNESS_FOR_WRONG_MASKS = (0.25, 0.12, 0.06, 0.03, 0.015), (0.5, 0.25, 0.12)
"""Pixels over which a ray turns from meeting the glass to missing it, in one round after the other. Exact masks say
what the ray through each pixel's center does, and some of these rays graze the glass within a hundredth of a pixel."""
NEAR, NEAR_FOR_WRONG_MASKS = 0.5, 1.0
"""Pixels from the hull beyond which rays say nothing of its surface."""
RAYS = 40_000
"""Largest number of rays that are looked at."""
STEPS, ENOUGH = 10, 1e-4
"""Largest number of Newton steps in a round; a round ends when one gains less, relative to what is left."""
LEAST_DAMPING = 1e-6
"""Share of the curvature that is added to itself; where rays do not tell two numbers apart, it is singular without."""
PRICE = 0.3
"""Nats of likelihood for each unit by which the second derivative of the squared radii jumps, all in parts of the
largest radius. A cylinder whose edge has a radius of a tenth of its own jumps by 20 there."""
JUMP = 3.0
"""Beyond it, jumps count by their logarithm: creases may be sharp."""
SMOOTH = 1e-3
"""Jump below which jumps count by their squares."""
ENDS = 0.01
"""Parts of the largest radius at either end that are left as they are: a hull ends between two rays there."""
THREAD = 1e-3
"""Radius in parts of the largest one, below which glass ends."""
SHELF = np.tan(np.radians(40))
"""Steepest rise of the upper side of a foot, beside a stem."""
LEAST_SHELF = 0.15
"""Least width of such a side, in parts of the largest radius."""
LEAST_PLACES = 8
"""Fewer heights show no curvature."""
PLACES = (48, 9, 9)
"""Places along a ray at which its distance from the surface is looked up, then those around the least."""
WINDOW = 1.1
"""Radius of the cylinder in which rays are looked at, in parts of the largest radius."""
STEP = 1e-6
"""Metres by which the axis is moved to find derivatives."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Profile:
    """A body about an axis, by its squared radii at evenly spaced heights."""

    axis: Axis
    heights: Float64[np.ndarray, " height"]
    squares: Float64[np.ndarray, " height"]
    """Squared radii, in square metres."""


Passes = tuple[NearRays, Float64[np.ndarray, " ray"], Float64[np.ndarray, " ray"], Float64[np.ndarray, " ray"]]
"""The rays that pass where radii are fitted, where and how far, and the widths over which they turn."""


class _Places(NamedTuple):
    """Places along rays, beside a surface."""

    distance: Float64[np.ndarray, "ray place"]
    """Metres from the surface, to first order; negative inside, infinite beyond its ends."""
    below: Int[np.ndarray, "ray place"]
    """The last height below."""
    share: Float64[np.ndarray, "ray place"]
    """Share of the way to the next height."""
    steepness: Float64[np.ndarray, "ray place"]
    """Derivative of the squared distance from the axis by the distance from the surface."""


def between_rays(hull: Hull, rays: NearRays) -> Hull:
    """The hull with radii, and an axis moved sideways, that explain the rays on both sides; ends and feet stay."""
    inside = np.flatnonzero(hull.radii > 0)
    if len(inside) < LEAST_PLACES:
        return hull
    heights, radii = hull.heights[inside], hull.radii[inside]
    is_free = _is_free(heights, radii)
    if is_free.sum() < LEAST_PLACES:
        return hull
    profile = _Profile(axis=hull.axis, heights=heights, squares=radii**2)
    edge = rays.at_edges().thinned(RAYS)
    t = _closest(edge, profile)
    near = NEAR if hull.is_exact else NEAR_FOR_WRONG_MASKS
    edge = edge.only(np.abs(_at(edge, t, profile).distance[:, 0]) < near * rays.pixel_angle * t)
    if not edge.hits.any() or edge.hits.all():
        return hull
    for softness in SOFTNESS if hull.is_exact else SOFTNESS_FOR_WRONG_MASKS:
        profile = _descended(edge, profile, is_free, softness)
    # Beyond heights at which the glass closes over its axis, there is none.
    changed, found = np.zeros_like(hull.radii), np.sqrt(profile.squares)
    part, _ = ndimage.label(found >= THREAD * found.max())  # pyright: ignore[reportGeneralTypeIssues]
    if not hull.is_exact:  # Beside a foot, few rays say how wide it is at most.
        off = PIXELS_OFF * rays.pixel_angle * float(np.median(t))
        found = np.clip(found, radii - off, radii + off)
    changed[inside] = np.where(part == part[profile.squares.argmax()], found, 0)
    return dataclasses.replace(hull, axis=profile.axis, radii=changed)


def _is_free(heights: Float64[np.ndarray, " height"], radii: Float64[np.ndarray, " height"]) -> Bool[np.ndarray, "_"]:
    """Heights whose radii are fitted: not the ends, nor a foot from its edge to a stem, if its upper side, which masks
    don't show, rises less steeply than a stem or a side."""
    end, reach = ENDS * radii.max(), radii + heights
    is_free = (heights > heights[0] + end) & (heights < heights[-1] - end)
    lower = heights < heights.min() + np.ptp(heights) / 2
    stem = int(np.where(lower, reach, np.inf).argmin())
    edge = int(reach[: stem + 1].argmax())
    width, rise = radii[edge] - radii[stem], heights[stem] - heights[edge]
    if width > LEAST_SHELF * radii.max() and 0 < rise < SHELF * width:
        is_free[: stem + 1] = False
    return is_free


def _descended(rays: NearRays, profile: _Profile, is_free: Bool[np.ndarray, " height"], softness: float) -> _Profile:
    """The profile after damped Newton steps."""
    heights, size = profile.heights, float(np.sqrt(profile.squares.max()))
    bends = np.diff(np.eye(len(heights)), 2, axis=0) * (size / (heights[1] - heights[0])) ** 2
    jumps = np.diff(bends, axis=0)[is_free[:-3] & is_free[3:]] / size**2
    moves = np.append(is_free, [True, True])

    def judge(profile: _Profile) -> tuple[float, Passes]:
        """The misfit, and how rays pass."""
        t = _closest(rays, profile)
        places = _at(rays, t, profile)
        kept = (is_free[places.below] & is_free[places.below + 1])[:, 0]
        some, t, distance = rays.only(kept), t[kept], places.distance[kept, 0]
        width = softness * rays.pixel_angle * t
        if not len(t):
            return np.inf, (some, t, distance, width)
        wrong = float(misfits(distance, some.hits, width).mean()) * len(t)
        return float(wrong + _price(jumps @ profile.squares).sum()), (some, t, distance, width)

    def step(profile: _Profile, passes: Passes, damping: float) -> _Profile:
        some, t, distance, width = passes
        slope, curvature = pull(distance, some.hits, width)
        slopes = _slopes(some, t, profile)
        # Newton's unknowns: squares in parts of the size's, and the axis in parts of the size.
        slopes = slopes @ sparse.diags_array(np.append(np.full(len(heights), size**2), [size, size]))
        seen = (slopes.T @ sparse.diags_array(curvature) @ slopes).toarray()
        matrix = seen + np.diag(damping * seen.diagonal() + 1e-9 * seen.diagonal().mean() + 1e-12)
        leaps = jumps @ profile.squares
        stiff = (jumps.T * _stiffness(leaps)) @ jumps * size**4
        matrix[:-2, :-2] += stiff
        gradient = slopes.T @ slope
        gradient[:-2] += stiff @ profile.squares / size**2
        way = np.zeros(len(gradient))
        way[moves] = np.linalg.solve(matrix[np.ix_(moves, moves)], gradient[moves])
        squares = np.maximum(profile.squares - size**2 * way[:-2], 1e-12)
        axis = profile.axis.moved(np.zeros(2), -size * way[-2:])
        return dataclasses.replace(profile, axis=axis, squares=squares)

    damping, (loss, passes) = 1e-3, judge(profile)
    for _ in range(STEPS):
        tried = step(profile, passes, damping)
        new, new_passes = judge(tried)
        if new < loss:
            gain, profile, loss, passes = loss - new, tried, new, new_passes
            damping = max(damping / 4, LEAST_DAMPING)
            if gain < ENOUGH * loss:
                break
        elif damping > 1e3:
            break
        else:
            damping *= 8
    return profile


def _price(leaps: Float64[np.ndarray, " jump"]) -> Float64[np.ndarray, " jump"]:
    """What jumps of curvature cost, in nats."""
    return PRICE * JUMP * np.log1p(np.sqrt(leaps**2 + SMOOTH**2) / JUMP)


def _stiffness(leaps: Float64[np.ndarray, " jump"]) -> Float64[np.ndarray, " jump"]:
    """Curvature of the parabola that touches the price from above."""
    size = np.sqrt(leaps**2 + SMOOTH**2)
    return PRICE / (size * (1 + size / JUMP))


def _closest(rays: NearRays, profile: _Profile) -> Float64[np.ndarray, " ray"]:
    """Metres along rays to where they are closest to a surface, up to the first known one where they miss it."""
    _, from_axis = along_and_across(rays.origins - profile.axis.point, profile.axis)
    _, across = along_and_across(rays.directions, profile.axis)
    flat = np.maximum(np.einsum("rc,rc->r", across, across), 1e-12)
    middle = -np.einsum("rc,rc->r", from_axis, across) / flat
    off = from_axis + middle[:, None] * across
    reach = WINDOW * np.sqrt(profile.squares.max())
    half = np.sqrt(np.maximum(reach**2 - np.einsum("rc,rc->r", off, off), (0.1 * reach) ** 2) / flat)
    last = np.where(rays.hits, np.inf, rays.reach)
    low, high = np.minimum(np.maximum(middle - half, 0), last), np.minimum(middle + half, last)
    return closest(lambda t: _at(rays, t, profile).distance, low, high, PLACES)


def _at(rays: NearRays, t: Float64[np.ndarray, "ray *place"], profile: _Profile) -> _Places:
    """How far from the surface places along rays are."""
    t = t.reshape(len(t), -1)
    axis, heights, squares = profile.axis, profile.heights, profile.squares
    step = heights[1] - heights[0]
    ways = np.stack([*perpendicular(axis.direction), axis.direction], axis=1)
    starts, directions = (rays.origins - axis.point) @ ways, rays.directions @ ways
    x, y, height = (starts[:, [each]] + t * directions[:, [each]] for each in range(3))
    at = (height - heights[0]) / step
    place = np.clip(at.astype(int), 0, len(heights) - 2)
    share, rise = at - place, squares[place + 1] - squares[place]
    square = squares[place] + share * rise
    steepness = np.sqrt(4 * np.maximum(square, 0) + (rise / step) ** 2 + 1e-12)
    is_on = (share >= 0) & (share <= 1)
    distance = np.where(is_on, (x**2 + y**2 - square) / steepness, np.inf)
    return _Places(distance, place, share, steepness)


def _slopes(rays: NearRays, t: Float64[np.ndarray, " ray"], profile: _Profile) -> sparse.csr_array:
    """Derivatives of the distances by the squared radii, and by the axis's place across it."""
    count, row = len(t), np.repeat(np.arange(len(t)), 2)
    distance, below, share, steepness = (each[:, 0] for each in _at(rays, t, profile))
    columns = np.stack([below, below + 1], axis=1).ravel()
    shares = -np.stack([1 - share, share], axis=1) / steepness[:, None]
    by_squares = sparse.csr_array((shares.ravel(), (row, columns)), shape=(count, len(profile.heights)))
    by_axis = []
    for shift in STEP * np.eye(2):
        moved = dataclasses.replace(profile, axis=profile.axis.moved(np.zeros(2), shift))
        by_axis.append((_at(rays, t, moved).distance[:, 0] - distance) / STEP)
    return sparse.csr_array(sparse.hstack([by_squares, sparse.csr_array(np.stack(by_axis, axis=1))]))
