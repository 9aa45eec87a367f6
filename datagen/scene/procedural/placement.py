"""Where things stand: each in an upright cylinder of its own, so that none touches another."""

from collections.abc import Sequence

import numpy as np

from datagen.scene.procedural.thing import Thing, put

CLEARANCE = 0.012
"""Metres between the cylinders around two things, at least."""
TRIES = 40
"""Places that are tried for a thing before the room for all of them is made larger."""


def spread_out(things: Sequence[Thing], *, rng: np.random.Generator) -> list[Thing]:
    """The things side by side around the z axis, each turned to any side; the same order."""
    places = free_places([thing.reach for thing in things], clearance=CLEARANCE, rng=rng)
    return [
        put(thing, (x, y, 0.0), turn_deg=float(rng.uniform(0, 360)))
        for thing, (x, y) in zip(things, places, strict=True)
    ]


def free_places(reaches: Sequence[float], *, clearance: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Centres of circles of these radii that keep clear of each other, close together around the origin."""
    room = 0.9 * float(np.sum(np.square(reaches))) ** 0.5
    found: dict[int, np.ndarray] = {}
    for index in sorted(range(len(reaches)), key=lambda index: -reaches[index]):
        while index not in found:
            for _ in range(TRIES):
                angle, away = rng.uniform(0, 2 * np.pi), room * rng.uniform() ** 0.5
                place = away * np.array([np.cos(angle), np.sin(angle)])
                if all(
                    np.linalg.norm(place - other) >= reaches[index] + reaches[number] + clearance
                    for number, other in found.items()
                ):
                    found[index] = place
                    break
            else:
                room *= 1.1
    middle = np.mean(list(found.values()), axis=0)
    placed = np.round([found[index] - middle for index in range(len(reaches))], 4)
    return [(float(x), float(y)) for x, y in placed]
