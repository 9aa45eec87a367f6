"""Which kind of shape an object has: the one whose silhouettes differ least from its masks; drinks and their levels.

A camera sees a drink first only through its vessel's opening, so the vessel surrounds the drink's mask. Other objects
seen only through an opening, such as marbles, are mistaken for drinks.
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float64
from scipy import ndimage

from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.terminal.command import say, waiting
from hyaline_photos.fit.boxes import fit_box
from hyaline_photos.fit.found import FoundGlass
from hyaline_photos.fit.hull import HullShape, carve, overruled_views
from hyaline_photos.fit.outside import (
    Hull,
    crossings,
    find_ball,
    find_center,
    find_hull,
    find_outside,
    find_solid,
    overruled_about,
)
from hyaline_photos.fit.profiles import between_rays
from hyaline_photos.fit.search import USUAL, WALLS
from hyaline_photos.fit.shapes import WATER, Glass, Revolution
from hyaline_photos.fit.views import NearRays, Sightings, as_convex, rays_near, rays_of, unexplained, without_views

STANDS = 0.1
"""Largest gap between an object's lowest point, as masks show it, and its support, relative to its radius."""
GAP = 0.01
"""Gap between an object and its support, relative to its radius. Without a gap, rays hit either surface at random."""

StandsOn = Callable[[Float64[np.ndarray, "3"], float], float | None]
"""Height along up of a known surface no farther than this above or below a point; None: there is none."""
LEAST_VIEWS = 3
"""Training pictures that must show an object first; fewer never give its shape."""
GOOD, GOOD_FOR_WRONG_MASKS = 0.012, 0.03
"""Share of edge pixels that a shape may get wrong before other kinds are tried; where masks may be wrong, too."""
BALL, OUTLINE, HULL, HULL_FOR_WRONG_MASKS = 0.0, 1.0, 3.0, 6.0
"""Complexity of a ball, of a box or an outline about an axis, and of a hull; of that where masks may be wrong, too."""
SIMPLER = 0.006
"""Share of edge pixels that a unit of complexity has to explain."""


def choose_shown(dataset: Dataset, sightings: Sightings, *, must_be_all: bool) -> tuple[int, ...]:
    """Ids of the unknown objects whose shape pictures show: enough views see them first, and rays pass beside them.

    Args:
        must_be_all: refuse objects that pictures do not show well enough, instead of taking them as known.
    """
    holders = find_holders(sightings)

    def is_shown(object_id: int) -> bool:
        if sightings.sees(object_id).any(axis=(1, 2)).sum() < LEAST_VIEWS:
            return False
        if object_id in holders or object_id in holders.values():
            return True  # The rays beside a drink meet its vessel.
        edge = rays_near(sightings, object_id).at_edges()
        return bool(edge.hits.any() and (~edge.hits).any())

    shown = tuple(filter(is_shown, sightings.unknown))
    names = ", ".join(dataset.objects[each - 1].name for each in sightings.unknown if each not in shown)
    if not shown or (names and must_be_all):
        raise HyalineError(
            f"{dataset.root}: pictures do not show the outside of {names}; {LEAST_VIEWS} training pictures must show "
            "an object first, and one its edge. Objects left out of --unknown are taken as known"
        )
    if names:
        say(f"taken as known, because pictures do not show their outside: {names}")
    return shown


def choose_outside(
    sightings: Sightings, object_id: int, up: Float64[np.ndarray, "3"], *, mask_errors: int, stands_on: StandsOn
) -> FoundGlass:
    """The outside of one object: a ball, about an axis, a box, or a hull of any shape.

    Args:
        mask_errors: percentage of the views whose masks may be wrong about a place.

    Raises:
        HyalineError: the masks do not show it.
    """
    overruled = overruled_views(sightings, object_id, up) if mask_errors else np.zeros(0, int)
    sightings = without_views(sightings, object_id, overruled)
    rays = rays_near(sightings, object_id)
    # About an axis, views contradict each other that do not as views of any shape.
    overruled_too = overruled_about(rays, up) if mask_errors else np.zeros(0, int)
    around = rays.only(~np.isin(rays.view, overruled_too))
    if mask_errors:
        say(f"    overruled views: {len(overruled)}, and {len(overruled_too)} more if it is round")
    with waiting("    axis"):
        hull = find_hull(around, up, order=math.ceil(mask_errors / 100 * len(np.unique(around.view))))
    support = None
    if hull.radii.any():
        lowest, radius = hull.heights[hull.radii > 0][0], float(hull.radii.max())
        support = _support(hull.axis.point + lowest * hull.axis.direction, STANDS * radius, radius, stands_on)
    tried: list[tuple[float, Glass, float]] = []

    def judge(complexity: float, glass: Glass, rays: NearRays = rays) -> None:
        tried.append((complexity, glass, unexplained(glass.mesh(), rays)))
        say(f"    {glass.kind}: {tried[-1][2]:.2%} of the pixels at its mask's edge are wrong")

    def is_poor() -> bool:
        return min((wrong for *_, wrong in tried), default=1.0) > (GOOD_FOR_WRONG_MASKS if mask_errors else GOOD)

    for complexity, glass in _round(around, hull, up, support):
        judge(complexity, glass, around)
    if is_poor():
        middle, radius = find_center(rays, up)
        below = _support(middle - radius * up, radius, radius, stands_on) if support is None else support
        if (box := fit_box(rays_near(as_convex(sightings, object_id), object_id), up, below)) is not None:
            judge(OUTLINE, box)
    if is_poor():
        with contextlib.suppress(HyalineError), waiting("    visual hull"):  # Nothing is inside all masks.
            judge(HULL_FOR_WRONG_MASKS if mask_errors else HULL, carve(sightings, object_id, up, support))
    if not tried:
        raise HyalineError("masks do not show its shape: too few pixels see it, or no point is inside all masks")
    _, glass, wrong = min(tried, key=lambda each: each[2] + each[0] * SIMPLER)
    # Unwrapping takes longer than carving, and most hulls are only tried.
    glass = glass.unwrapped() if isinstance(glass, HullShape) else glass
    overruled = np.union1d(overruled, overruled_too) if isinstance(glass, Revolution) else overruled
    return FoundGlass(glass=glass, unexplained=wrong, overruled=tuple(overruled.tolist()))


def _round(
    rays: NearRays, hull: Hull, up: Float64[np.ndarray, "3"], support: float | None
) -> list[tuple[float, Glass]]:
    """Ball and outlines about one axis, with their complexity."""
    ball = find_ball(hull)
    found: list[tuple[float, Glass]] = [] if ball is None else [(BALL, ball)]
    fitted, along = between_rays(hull, rays), None
    if support is not None:
        along = float((support - hull.axis.point @ up) / (hull.axis.direction @ up))
    outside, solid = find_outside(fitted, along), find_solid(fitted, along)
    if outside is None or (solid is not None and not solid.has_flat_top):
        outline = solid
    else:
        outline = outside if solid is None else dataclasses.replace(outside, solid=solid.solid)
    return found if outline is None else [*found, (OUTLINE, outline)]


def _support(point: Float64[np.ndarray, "3"], reach: float, radius: float, stands_on: StandsOn) -> float | None:
    """Height of the known surface below an object of this radius, plus the gap."""
    height = stands_on(point, reach)
    return None if height is None else height + GAP * radius


# Drinks


AROUND = 0.9
"""Least share of the pixels around a drink's mask that show its vessel."""
LEVELS, LEVEL_RAYS = 200, 100_000
"""Levels that are tried, and most rays that are looked at; together they take 0.5 GB."""
OPENING = 0.1
"""Margin at the rim, relative to the largest radius."""
WRONG = 0.1
"""Largest balanced error of a level: the mean of its error rates on rays that see the drink and rays that don't."""


def find_holders(sightings: Sightings) -> dict[int, int]:
    """Possible drinks by object id, each with the id of the object around it.

    Of several things in one object, the drink is what most pixels show.
    """
    sizes = {object_id: int(sightings.sees(object_id).sum()) for object_id in sightings.unknown}
    holders = {}
    for object_id in sorted(sizes, key=sizes.__getitem__):
        seen = sightings.sees(object_id)
        ring = np.asarray(ndimage.binary_dilation(seen, np.ones((1, 3, 3), bool)), bool) & ~seen
        counts = np.bincount(sightings.first[ring], minlength=256)
        around = max(sightings.unknown, key=counts.__getitem__)
        if around != object_id and counts[around] > AROUND * counts.sum():
            holders[around] = object_id
    return {drink: vessel for vessel, drink in holders.items() if vessel not in holders.values()}


def merged(sightings: Sightings, holders: Mapping[int, int]) -> Sightings:
    """Counts each drink's pixels as its vessel's."""
    first = sightings.first.copy()
    for drink, vessel in holders.items():
        first[sightings.sees(drink)] = vessel
    unknown = tuple(object_id for object_id in sightings.unknown if object_id not in holders)
    return dataclasses.replace(sightings, first=first, unknown=unknown)


def with_drink(glass: Glass, sightings: Sightings, drink: int, vessel: int) -> Revolution | None:
    """Adds a drink to a vessel, at the level that masks show; None if the inner object is not a drink.

    A ray through the opening sees the drink if it crosses the drink's surface inside the wall.
    """
    if not isinstance(glass, Revolution) or glass.is_closed:
        return None
    seen = sightings.sees(drink)
    rays = rays_of(sightings, seen | sightings.sees(vessel), seen, seen).thinned(LEVEL_RAYS)
    rays = dataclasses.replace(rays, reach=np.full(len(rays.hits), np.inf))
    radii, lowest = glass.outside[:, 0], float(glass.outside[:, 1].min())
    heights = np.linspace(lowest, glass.outside[-1, 1], LEVELS + 2)[1:-1]
    at_rim = crossings(rays, glass.axis, glass.outside[-1:, 1])[:, 0]
    enters = at_rim < radii[-1] - OPENING * radii.max()
    sees_drink = rays.hits[enters]
    if not sees_drink.any() or sees_drink.all():
        return None
    rho = crossings(rays, glass.axis, heights)[enters]
    outside = np.interp(heights, glass.outside[:, 1], radii)
    within = [rho < outside - wall * radii.max() for wall in WALLS]
    seen, false = (np.array([part[rows].mean(axis=0) for part in within]) for rows in (sees_drink, ~sees_drink))
    wrong = ((1 - seen + false) / 2).min(axis=0)
    if wrong.min() > WRONG:
        return None
    hollow = glass if glass.hollow else glass.hollowed(*USUAL)
    return hollow.having(level=float(heights[wrong.argmin()] - lowest), drink_ior=WATER)
