"""Finds drinks in vessels and their levels from masks.

A camera sees a drink first only through its vessel's opening, so the vessel surrounds the drink's mask. Other objects
seen only through an opening, such as marbles, are mistaken for drinks.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Int
from scipy import ndimage

from hyaline_photos.fit.outside import crossings
from hyaline_photos.fit.search import USUAL, WALLS
from hyaline_photos.fit.shapes import Glass, Revolution
from hyaline_photos.fit.views import NearRays, Sightings

AROUND = 0.9
"""Least share of the pixels around a drink's mask that show its vessel."""

LEVELS, LEVEL_RAYS = 200, 100_000
"""Levels that are tried, and most rays that are looked at; together they take 0.5 GB."""

OPENING = 0.1
"""Margin at the rim, relative to the largest radius."""

WRONG = 0.1
"""Largest balanced error of a level: the mean of its error rates on rays that see the drink and rays that don't."""

WATER = 1.33
"""First guess of the index."""


def find_holders(sightings: Sightings) -> dict[int, int]:
    """Possible drinks by object id, each with the id of the object around it.

    Of several things in one object, such as a drink and ice that sticks out of it, the drink is what most pixels show.
    """
    around = {}
    for object_id in sightings.unknown:
        seen = sightings.sees(object_id)
        ring = np.asarray(ndimage.binary_dilation(seen, np.ones((1, 3, 3), bool))) & ~seen
        around[object_id] = np.bincount(sightings.first[ring], minlength=256)
    holders = {}
    for vessel in sightings.unknown:
        if inside := _surrounded_by(vessel, around):
            holders[max(inside, key=lambda each: int(sightings.sees(each).sum()))] = vessel
    return {drink: vessel for drink, vessel in holders.items() if vessel not in holders}


def _surrounded_by(vessel: int, around: Mapping[int, Int[np.ndarray, "256"]]) -> list[int]:
    """The objects around which pixels show hardly anything but a vessel and each other.

    Args:
        around: for each object, how many pixels beside its own show each object id.
    """
    inside = [each for each in around if each != vessel]
    while True:
        kept = [each for each in inside if around[each][[vessel, *inside]].sum() > AROUND * max(around[each].sum(), 1)]
        if kept == inside:
            return inside
        inside = kept


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
    rays = _rays_to(sightings, drink, vessel).thinned(LEVEL_RAYS)
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


def _rays_to(sightings: Sightings, drink: int, vessel: int) -> NearRays:
    """Rays that see a drink (hits) or its vessel (misses)."""
    origins, directions = sightings.rays()
    view, row, column = np.nonzero(np.isin(sightings.first, (drink, vessel)))
    return NearRays(
        origins=origins[view].astype(np.float64),
        directions=directions[view, row, column].astype(np.float64),
        hits=sightings.first[view, row, column] == drink,
        reach=np.full(len(view), np.inf),
        view=view,
        is_edge=np.zeros(len(view), bool),
        pixel_angle=1 / sightings.cameras.focal,
    )
