"""Glasses, bowls, bottles, flasks and tanks of random outlines, their walls thick or thin, plain or cut."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.modelling import Around, curved, filled, filleted, lathe, walled
from hyaline_random.chance import pick
from hyaline_random.solids import ROUND, corners_of, flutes, outside_only, polygon, soft_square

Outline = list[tuple[float, float]]

REACH = 0.0008
"""Metres that a drink reaches into its glass."""


@dataclass(frozen=True, kw_only=True)
class Vessel:
    """A vessel before it is turned: what its glass and its drink are made from."""

    outer: Outline
    wall: float
    floor: float
    """Height of its lowest inner point."""
    brim: float
    """Highest level, in metres, to which it is filled."""
    is_open: bool
    """Whether ice and other things come in from above."""
    around: Around | None = None
    is_cut: bool = False
    """Whether `around` shapes the outside alone."""
    is_box: bool = False
    """Whether its inside has corners instead of a round bottom."""
    segments: int = ROUND
    crease_deg: float = 30.0

    def glass(self) -> Mesh:
        """The vessel itself."""
        outline = walled(self.outer, wall=self.wall, floor=self.floor)
        if self.is_box:
            radius, top = self.outer[-1]
            hollow = [(radius - self.wall, top), (radius - self.wall, self.floor), (0.0, self.floor)]
            outline = [*self.outer, *hollow]
        return lathe(outline, segments=self.segments, crease_deg=self.crease_deg, around=self.around)

    def drink(self, level: float) -> Mesh:
        """What fills it up to a level."""
        section = None if self.is_cut else self.around
        return lathe(self._drink(level), segments=self.segments, crease_deg=self.crease_deg, around=section)

    def inner_radius(self, level: float) -> float:
        """Radius of the hollow at a level."""
        return self._drink(level)[1][0] - REACH

    def _drink(self, level: float) -> Outline:
        if self.is_box:
            radius, bottom = self.outer[-1][0] - self.wall + REACH, self.floor - REACH
            return [(0.0, level), (radius, level), (radius, bottom), (0.0, bottom)]
        return filled(self.outer, wall=self.wall, floor=self.floor, level=level, reach=REACH)


Maker = Callable[[np.random.Generator], Vessel]


def _tumbler(rng: np.random.Generator) -> Vessel:
    radius, height = rng.uniform(0.031, 0.039), rng.uniform(0.07, 0.105)
    top = radius * rng.uniform(1.0, 1.25)
    corners = [(0, 0, 0), (radius, 0, rng.uniform(0.003, 0.008)), (top, height, 0)]
    return _straight(corners, height, wall=rng.uniform(0.0025, 0.0045), floor=rng.uniform(0.009, 0.02))


def _highball(rng: np.random.Generator) -> Vessel:
    radius, height = rng.uniform(0.027, 0.032), rng.uniform(0.12, 0.155)
    top = radius * rng.uniform(1.0, 1.2)
    return _straight([(0, 0, 0), (radius, 0, 0.005), (top, height, 0)], height, wall=0.0026, floor=0.011)


def _cut_tumbler(rng: np.random.Generator) -> Vessel:
    """Heavy crystal: flat or fluted outside, round inside."""
    radius, height = rng.uniform(0.034, 0.040), rng.uniform(0.08, 0.10)
    top = radius * rng.uniform(1.0, 1.15)
    knee = 0.004
    outer = filleted([(0, 0, 0), (radius, 0, knee), (top, height, 0)], segments=4)
    # Points along the side, so that the cut can end below the rim.
    foot, side = outer[:-1], np.linspace(outer[-2], outer[-1], 30)[1:]
    outer = [*foot, *map(tuple, side.tolist())]
    count = pick((8, 9, 10, 12, 16), rng=rng)
    cut = polygon(count) if count <= 10 else flutes(count, rng.uniform(0.05, 0.09))
    return Vessel(
        outer=outer,
        wall=rng.uniform(0.006, 0.008),
        floor=rng.uniform(0.014, 0.022),
        brim=0.7 * height,
        is_open=True,
        around=outside_only(cut, len(outer), low=0.1 * height, high=rng.uniform(0.6, 0.85) * height),
        segments=corners_of(count),
        crease_deg=20,
        is_cut=True,
    )


def _bowl(rng: np.random.Generator) -> Vessel:
    radius, height = rng.uniform(0.055, 0.07), rng.uniform(0.05, 0.075)
    foot = radius * rng.uniform(0.4, 0.55)
    line = curved(
        [(foot, 0), (0.76 * radius, 0.3 * height), (0.94 * radius, 0.65 * height), (radius, height)], count=28
    )
    return _from_curve(line, wall=rng.uniform(0.003, 0.005), floor=0.010, brim=0.7 * height, is_open=True)


def _wine_glass(rng: np.random.Generator) -> Vessel:
    wide, stem = rng.uniform(0.032, 0.042), rng.uniform(0.035, 0.075)
    bowl, mouth = rng.uniform(0.05, 0.085), rng.uniform(0.78, 0.98)
    foot = filleted([(0, 0, 0), (0.9 * wide, 0, 0.0012), (0.9 * wide, 0.0026, 0.0012), (0.016, 0.0052, 0.02)])
    line = curved(
        [
            (0.0055, 0.012),
            (0.0042, 0.012 + 0.3 * stem),
            (0.0042, stem),
            (0.008, stem + 0.02),
            (0.73 * wide, stem + 0.038),
            (wide, stem + 0.068),
            (0.5 * (1 + mouth) * wide * 1.01, stem + 0.068 + 0.5 * bowl),
            (mouth * wide, stem + 0.068 + bowl),
        ],
        count=44,
    )
    outer = [*foot, *map(tuple, line.tolist())]
    return Vessel(
        outer=outer, wall=0.0022, floor=stem + 0.0265, brim=stem + 0.068 + 0.4 * bowl, is_open=False, segments=72
    )


def _bottle(rng: np.random.Generator) -> Vessel:
    """A carafe, a vase or a bottle."""
    height, wide = rng.uniform(0.15, 0.21), rng.uniform(0.038, 0.055)
    neck = rng.uniform(0.3, 0.55) * wide
    line = curved(
        [
            (rng.uniform(0.72, 0.95) * wide, 0.0),
            (wide, rng.uniform(0.12, 0.2) * height),
            (wide * rng.uniform(0.88, 1.0), 0.38 * height),
            (1.05 * neck, 0.74 * height),
            (neck, 0.85 * height),
            (neck * rng.uniform(1.05, 1.3), height),
        ],
        count=44,
    )
    return _from_curve(line, wall=rng.uniform(0.0026, 0.0036), floor=0.010, brim=0.55 * height, is_open=False)


def _flask(rng: np.random.Generator) -> Vessel:
    """A laboratory flask: conical below a straight neck."""
    height, wide = rng.uniform(0.12, 0.16), rng.uniform(0.042, 0.055)
    neck = rng.uniform(0.28, 0.38) * wide
    corners = [(0, 0, 0), (wide, 0, 0.008), (neck, 0.7 * height, 0.03), (neck, height, 0)]
    outer = _dense(filleted(corners, segments=8))
    return Vessel(outer=outer, wall=0.0022, floor=0.005, brim=0.45 * height, is_open=False)


def _jar(rng: np.random.Generator) -> Vessel:
    height, wide = rng.uniform(0.09, 0.12), rng.uniform(0.036, 0.044)
    corners = [
        (0, 0, 0),
        (wide, 0, 0.008),
        (wide, 0.78 * height, 0.012),
        (0.86 * wide, 0.86 * height, 0.006),
        (0.86 * wide, height, 0),
    ]
    outer = _dense(filleted(corners, segments=8))
    square = rng.random() < 0.4
    return Vessel(
        outer=outer,
        wall=rng.uniform(0.003, 0.004),
        floor=0.008,
        brim=0.72 * height,
        is_open=True,
        around=soft_square(rng.uniform(3, 6)) if square else None,
    )


def _tank(rng: np.random.Generator) -> Vessel:
    """A box of glass, as for fish: square or six-sided."""
    sides = pick((4, 4, 6), rng=rng)
    half, height = rng.uniform(0.06, 0.075), rng.uniform(0.08, 0.11)
    outer = filleted([(0, 0, 0), (half, 0, 0.001), (half, height, 0)], segments=2)
    return Vessel(
        outer=outer,
        wall=0.004,
        floor=0.006,
        brim=0.8 * height,
        is_open=True,
        around=polygon(sides),
        is_box=True,
        segments=corners_of(sides),
        crease_deg=20,
    )


VESSELS: dict[str, Maker] = {
    "tumbler": _tumbler,
    "highball": _highball,
    "cut tumbler": _cut_tumbler,
    "bowl": _bowl,
    "wine glass": _wine_glass,
    "bottle": _bottle,
    "flask": _flask,
    "jar": _jar,
    "tank": _tank,
}


def _straight(corners: list[tuple[float, float, float]], height: float, *, wall: float, floor: float) -> Vessel:
    outer = filleted(corners, segments=6)
    return Vessel(outer=outer, wall=wall, floor=floor, brim=0.78 * height, is_open=True)


def _from_curve(line: np.ndarray, *, wall: float, floor: float, brim: float, is_open: bool) -> Vessel:
    return Vessel(
        outer=[(0.0, 0.0), *map(tuple, line.tolist())], wall=wall, floor=floor, brim=brim, is_open=is_open, segments=80
    )


def _dense(outline: Outline, *, step: float = 0.008) -> Outline:
    """The outline with more points on its long straight parts: the inside of a wall is offset from point to point."""
    points = [outline[0]]
    for before, after in itertools.pairwise(outline[1:]):
        count = max(1, round(float(np.hypot(after[0] - before[0], after[1] - before[1])) / step))
        points += [tuple(p) for p in np.linspace(before, after, count, endpoint=False).tolist()]
    return [*points, outline[-1]]
