"""What stands in vessels: drinks, and how high they reach, from masks; and known things, which hide the vessel.

A drink is seen first only by rays that come in through its vessel's opening, so all around its mask lies the vessel.
Whatever else is seen so, such as a marble, is taken for a drink.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy import ndimage

from datagen.data.meshes import Mesh, is_there
from model.fit.outside import crossings, find_center
from model.fit.search import WALLS
from model.fit.shapes import Glass, Revolution
from model.fit.views import NearRays, Sightings, rays_near

NEAR_CENTER, WIDEST = 0.8, 1.5
"""Of a thing in a vessel: how far its middle may be from the vessel's, and half its diagonal, in parts of how far the
vessel reaches."""

AROUND = 0.9
"""Share of the pixels around a drink's mask that its vessel covers."""

LEVELS = 200

OPENING = 0.1
"""Part of the largest radius that is left out at the rim."""

WRONG = 0.1
"""Share of the rays through the opening that a level may explain wrongly: mean of those that see the drink and those
that don't."""

WATER = 1.33
"""First guess of the index."""

START = (0.05, 0.15, 0.3)
"""First guess of wall, floor and corner, in the units of the grid."""


def find_filling(sightings: Sightings, known: tuple[Mesh, ...]) -> Sightings:
    """The sightings with the known objects that stand in unknown ones marked."""
    filling = set()
    for object_id in sightings.unknown:
        rays = rays_near(sightings, object_id)
        if not rays.hits.any():
            continue
        center, reach = find_center(rays)
        for place, mesh in enumerate(known):
            if not is_there(mesh):
                continue
            low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
            is_near = np.linalg.norm((low + high) / 2 - center) < NEAR_CENTER * reach
            if is_near and np.linalg.norm(high - low) / 2 < WIDEST * reach:
                filling.add(place + 1)
    return dataclasses.replace(sightings, filling=tuple(sorted(filling)))


def find_holders(sightings: Sightings) -> dict[int, int]:
    """Ids of the objects that may be drinks, and of what surrounds each."""
    holders = {}
    hidden = np.isin(sightings.met, sightings.filling) & (sightings.first == 0)
    for object_id in sightings.unknown:
        seen = sightings.sees(object_id)
        ring = np.asarray(ndimage.binary_dilation(seen, np.ones((1, 3, 3), bool))) & ~seen & ~hidden
        around = np.bincount(sightings.first[ring], minlength=256)
        other = int(around[1:].argmax()) + 1
        if around[other] > AROUND * max(int(around.sum()), 1):
            holders[object_id] = other
    return {drink: vessel for drink, vessel in holders.items() if vessel not in holders}


def merged(sightings: Sightings, holders: Mapping[int, int]) -> Sightings:
    """The sightings with every drink's pixels as its vessel's."""
    first = sightings.first.copy()
    for drink, vessel in holders.items():
        first[sightings.sees(drink)] = vessel
    unknown = tuple(object_id for object_id in sightings.unknown if object_id not in holders)
    return dataclasses.replace(sightings, first=first, unknown=unknown)


def with_drink(glass: Glass, sightings: Sightings, drink: int, vessel: int) -> Revolution | None:
    """A vessel that holds a drink up to the level that masks show; None if what is inside is no drink.

    Of the rays that come in through the opening, those that cross the drink's surface inside the wall see the drink.
    """
    if not isinstance(glass, Revolution) or glass.is_closed:
        return None
    rays = _rays_to(sightings, drink, vessel)
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
    hollow = glass if glass.wall is not None else glass.hollowed(*START)
    return dataclasses.replace(hollow, level=float(heights[wrong.argmin()] - lowest), drink_ior=WATER)


def _rays_to(sightings: Sightings, drink: int, vessel: int) -> NearRays:
    """The rays that see a drink, which count as hits, or its vessel."""
    origins, directions = sightings.rays()
    view, row, column = np.nonzero(np.isin(sightings.first, (drink, vessel)))
    return NearRays(
        origins=origins[view].astype(np.float64),
        directions=directions[view, row, column].astype(np.float64),
        hits=sightings.first[view, row, column] == drink,
        reach=np.full(len(view), np.inf),
        view=view,
        is_edge=np.zeros(len(view), bool),
    )
