"""Finds drinks in vessels and their levels from masks.

A camera sees a drink first only through its vessel's opening, so the vessel surrounds the drink's mask. Other objects
seen only through an opening, such as marbles, are mistaken for drinks.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy import ndimage

from hyaline_photos.fit.outside import crossings
from hyaline_photos.fit.search import USUAL, WALLS
from hyaline_photos.fit.shapes import Glass, Revolution
from hyaline_photos.fit.views import Sightings, rays_of

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
