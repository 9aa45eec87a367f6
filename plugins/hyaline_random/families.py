"""Families of random scenes: what is in each, how large it is made, and what it stands on."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from hyaline_random.backdrop import Support
from hyaline_random.chance import between, pick, weigh
from hyaline_random.nesting import PANES, empty_vessel, enclosed, filled_vessel, onion, paperweight, solid
from hyaline_random.solids import CONVEX, NOT_CONVEX
from hyaline_random.things import THINGS, Thing, enlarged
from hyaline_random.vessels import VESSELS


@dataclass(frozen=True, kw_only=True)
class Family:
    """A kind of random scene."""

    draw: Callable[[np.random.Generator], list[Thing]]
    """The things of one scene, not placed yet; all random numbers come from the generator."""
    stands_on: Mapping[Support, float]
    """What the things stand on, and how often."""


def _object(rng: np.random.Generator) -> list[Thing]:
    """One object, as large as a melon: a convex body, one that is not, several media, or one in thin glass."""
    kind = weigh({"convex": 0.3, "not convex": 0.3, "media": 0.3, "thin": 0.1}, rng=rng)
    if kind == "convex":
        thing = solid(pick(tuple(CONVEX), rng=rng), rng=rng)
    elif kind == "not convex":
        names = (*NOT_CONVEX, "tumbler", "cut tumbler", "wine glass", "bottle", "jar")
        name = pick(names, rng=rng)
        thing = empty_vessel(name, rng=rng) if name in VESSELS else solid(name, rng=rng)
    elif kind == "thin":
        thing = enclosed(rng=rng)
    else:
        thing = _several_media(rng)
    return [enlarged(thing, between(1.6, 2.0, rng=rng))]


def _table(rng: np.random.Generator) -> list[Thing]:
    """Three to six glass things and two to four opaque ones."""
    things = []
    for _ in range(int(rng.integers(3, 7))):
        match weigh({"vessel": 0.26, "drink": 0.26, "solid": 0.34, "thin": 0.14}, rng=rng):
            case "vessel":
                thing = empty_vessel(pick([name for name in VESSELS if name != "tank"], rng=rng), rng=rng)
            case "drink":
                thing = filled_vessel(pick([name for name in VESSELS if name != "tank"], rng=rng), rng=rng)
            case "thin":
                thing = PANES[pick(tuple(PANES), rng=rng)](rng)
            case _:
                thing = solid(pick((*CONVEX, *NOT_CONVEX), rng=rng), rng=rng)
        things.append(enlarged(thing, between(1.3, 1.5, rng=rng)))
    return [*things, *_opaque(int(rng.integers(2, 5)), rng)]


def _nested(rng: np.random.Generator) -> list[Thing]:
    """One to three things of several media, and an opaque one or two."""
    things = [enlarged(_several_media(rng), between(1.4, 1.7, rng=rng)) for _ in range(int(rng.integers(1, 4)))]
    return [*things, *_opaque(int(rng.integers(1, 3)), rng)]


def _several_media(rng: np.random.Generator) -> Thing:
    match weigh({"drink": 0.5, "paperweight": 0.26, "onion": 0.12, "enclosed": 0.12}, rng=rng):
        case "drink":
            return filled_vessel(pick(tuple(VESSELS), rng=rng), rng=rng)
        case "paperweight":
            return paperweight(rng=rng)
        case "enclosed":
            return enclosed(rng=rng)
        case _:
            return onion(rng=rng)


def _opaque(count: int, rng: np.random.Generator) -> list[Thing]:
    return [enlarged(THINGS[pick(tuple(THINGS), rng=rng)](rng), between(1.0, 1.4, rng=rng)) for _ in range(count)]


OBJECT = Family(draw=_object, stands_on={"floor": 0.5, "plinth": 0.5})
TABLE = Family(draw=_table, stands_on={"table": 1.0})
NESTED = Family(draw=_nested, stands_on={"table": 0.6, "floor": 0.4})
