"""Cross sections that are polygons with rounded corners, as jars, tanks and prisms have; oblong ones, too."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy import optimize

SIDES = (3, 4, 5, 6, 8)
"""The polygons that are tried."""

LEAST_SHARPNESS, MOST_SHARPNESS = 2.0, 60.0
"""A square is a circle at 2; at 60, its corners have a radius of 2 % of its width."""

SHARP = np.inf
"""Sharpness of a polygon with edges."""

WORTH_A_SECTION = 0.5
"""Share of a circle's misfit that a polygon may leave."""

LEAST_CORNERS = 0.02
"""Standard deviation of the distance from the axis, relative to its mean, below which a section is round."""

TABLE = 4096
"""Angles at which a section is tabulated."""

LONG_SIDE = 8
"""Columns of a mesh on each long side of an oblong section."""

_UNIT = 2 * np.pi * np.arange(TABLE + 1) / TABLE


@dataclass(frozen=True, kw_only=True, eq=False)
class Columns:
    """Points around a section; an edge of a polygon has two."""

    angles: Float64[np.ndarray, " column"]
    """In radians."""
    factors: Float64[np.ndarray, " column"]
    """Distance from the axis, relative to the middle of a side."""
    slopes: Float64[np.ndarray, " column"]
    """Derivatives of the factors, per radian."""
    moved: Float64[np.ndarray, "column 2"]
    """Metres across the axis, by which the halves of an oblong section are apart."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """A regular polygon, which may have rounded corners and be cut in halves that are moved apart.

    With c_i the positive part of the cosine between a direction and the middle of side i, and p the sharpness, the
    distance from the axis is (sum of c_i^p)^(-1/p): four sides give a superellipse, and p = infinity the polygon.
    """

    sides: int
    sharpness: float
    turn: float
    """Direction of the middle of a side, in radians from the first vector perpendicular to the axis."""
    stretch: float = 0.0
    """How far each half of four sides is moved along that direction, in metres. It is the same for all radii of an
    outline, so that the wall of an oblong vessel is as thick on all sides."""

    @property
    def is_oblong(self) -> bool:
        return self.stretch > 0

    def factors(self, angles: Float[np.ndarray, "*angle"]) -> Float64[np.ndarray, "*angle"]:
        """Distance from the axis in these directions, relative to the middle of a side."""
        if self.sharpness == SHARP:
            return 1 / np.cos(self._from_middle(angles))
        at_side = self._sum(np.array([self.turn]))
        return (self._sum(angles) / at_side) ** (-1 / self.sharpness)

    def outline_radii(
        self, x: Float[np.ndarray, "*place"], y: Float[np.ndarray, "*place"]
    ) -> Float64[np.ndarray, "*place"]:
        """Radii of the outlines whose surfaces go through places beside the axis."""
        if self.is_oblong:
            cos, sin = np.cos(self.turn), np.sin(self.turn)
            inner = np.clip(x * cos + y * sin, -self.stretch, self.stretch)
            x, y = x - inner * cos, y - inner * sin
        place = (np.arctan2(y, x) % (2 * np.pi)) * (TABLE / (2 * np.pi))
        return np.hypot(x, y) / self.factors(_UNIT)[np.rint(place).astype(np.int32)]

    def middles(self) -> Float64[np.ndarray, "middle 2"]:
        """Places beside the axis to which a ray that meets the section may come close."""
        ends = (0.0, -self.stretch, self.stretch) if self.is_oblong else (0.0,)
        return self._along_turn(np.array(ends))

    def slopes(self, angles: Float[np.ndarray, "*angle"]) -> Float64[np.ndarray, "*angle"]:
        """Derivatives of `factors`, per radian."""
        if self.sharpness == SHARP:
            return self.factors(angles) * np.tan(self._from_middle(angles))
        cos, sin = self._towards(angles)
        return self.factors(angles) * (cos ** (self.sharpness - 1) * sin).sum(axis=-1) / self._sum(angles)

    def columns(self, count: int) -> Columns:
        """Points for a mesh."""
        if self.sharpness == SHARP:
            return self._of_polygon(count)
        if not self.is_oblong:
            return self._at(self._spread(np.arange(count) * (2 * np.pi / count)), np.zeros((count, 2)))
        half, last = count // 2 - LONG_SIDE, LONG_SIDE - 1
        arc = self._spread(self.turn + np.pi * (np.arange(half + 1) / half - 0.5))
        side = np.linspace(self.stretch, -self.stretch, LONG_SIDE + 1)[1:-1]
        angles = np.concatenate([arc, np.full(last, arc[-1]), arc + np.pi, np.full(last, arc[0])])
        moved = np.full(half + 1, self.stretch)
        return self._at(angles, self._along_turn(np.concatenate([moved, side, -moved, side[::-1]])))

    def _at(self, angles: np.ndarray, moved: np.ndarray) -> Columns:
        return Columns(angles=angles, factors=self.factors(angles), slopes=self.slopes(angles), moved=moved)

    def _spread(self, ways: Float64[np.ndarray, " angle"]) -> Float64[np.ndarray, " angle"]:
        """Directions of points around the section, half of them for its way around, half for the turns of its normals,
        so that corners are round.

        Args:
            ways: the same for a circle; at the middles of sides, both are equal.
        """
        normals = _UNIT - np.arctan2(self.slopes(_UNIT), self.factors(_UNIT))
        way = (_UNIT + normals) / 2
        return np.interp((ways - way[0]) % (2 * np.pi), way - way[0], _UNIT)

    def _of_polygon(self, count: int) -> Columns:
        """Evenly along each side, whose columns have its normal."""
        ends = np.arange(self.sides + 1) * count // self.sides
        side, step = np.repeat(np.arange(self.sides), np.diff(ends)), 2 * np.pi / self.sides
        share = np.concatenate([np.linspace(-1, 1, size) for size in np.diff(ends)])
        along = share * np.tan(step / 2)
        angles = self.turn + side * step + np.arctan(along)
        # Sides that meet share their corners bit by bit.
        angles[ends[:-1]] = np.roll(angles[ends[1:] - 1], 1)
        factors = np.sqrt(1 + along**2)
        # The long sides of an oblong section are the second and the fourth.
        moved = self.stretch * np.select([side == 0, side == 2], [1.0, -1.0], (side - 2) * share)
        return Columns(angles=angles, factors=factors, slopes=along * factors, moved=self._along_turn(moved))

    def _along_turn(self, distances: Float64[np.ndarray, " place"]) -> Float64[np.ndarray, "place 2"]:
        return distances[:, None] * np.array([np.cos(self.turn), np.sin(self.turn)])

    def _from_middle(self, angles: Float[np.ndarray, "*angle"]) -> Float64[np.ndarray, "*angle"]:
        """Direction from the middle of the nearest side, in radians."""
        step = 2 * np.pi / self.sides
        return (angles - self.turn + step / 2) % step - step / 2

    def _towards(self, angles: Float[np.ndarray, "*angle"]) -> tuple[np.ndarray, np.ndarray]:
        """Cosine towards each side's middle where it is positive, and sine."""
        away = angles[..., None] - self.turn - 2 * np.pi / self.sides * np.arange(self.sides)
        return np.maximum(np.cos(away), 0), np.sin(away)

    def _sum(self, angles: Float[np.ndarray, "*angle"]) -> Float64[np.ndarray, "*angle"]:
        return (self._towards(angles)[0] ** self.sharpness).sum(axis=-1)


def guess_section(angles: Float64[np.ndarray, " angle"], radii: Float64[np.ndarray, " angle"]) -> Section | None:
    """The polygon that distances from an axis resemble most; None if a circle does nearly as well.

    Args:
        angles: evenly spaced around the axis.
        radii: in any unit.
    """
    relative = np.log(radii / np.median(radii))
    if relative.std() < LEAST_CORNERS:
        return None

    def left(section: Section) -> float:
        difference = relative - np.log(section.factors(angles))
        return float(np.abs(difference - np.median(difference)).mean())

    found = min((_sharpened(sides, angles, relative, left) for sides in SIDES), key=left)
    return found if left(found) < WORTH_A_SECTION * float(np.abs(relative).mean()) else None


def _sharpened(sides: int, angles: np.ndarray, relative: np.ndarray, left: Callable[[Section], float]) -> Section:
    """The polygon of this many sides that leaves least."""
    # The wave with as many crests as corners says where these are.
    corner = -np.angle((relative * np.exp(-1j * sides * angles)).mean()) / sides

    def of(log_sharpness: float) -> Section:
        return Section(sides=sides, sharpness=float(np.exp(log_sharpness)), turn=float(corner + np.pi / sides))

    bounds = np.log([LEAST_SHARPNESS, MOST_SHARPNESS])
    return of(optimize.minimize_scalar(lambda x: left(of(x)), bounds=bounds, method="bounded").x)
