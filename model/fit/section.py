"""Cross sections that are polygons with rounded corners, as jars, tanks and prisms have."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy import optimize

SIDES = (3, 4, 5, 6, 8)
"""The polygons that are tried."""

LEAST_SHARPNESS, MOST_SHARPNESS = 2.0, 60.0
"""A square is a circle at 2; at 60, its corners have a radius of 2 % of its width."""

WORTH_A_SECTION = 0.5
"""Share of a circle's misfit that a polygon may leave."""

LEAST_CORNERS = 0.02
"""Standard deviation of the distance from the axis, relative to its mean, below which a section is round."""

TABLE = 4096
"""Angles at which a section is tabulated."""

_UNIT = 2 * np.pi * np.arange(TABLE + 1) / TABLE


@dataclass(frozen=True, kw_only=True)
class Section:
    """A regular polygon with rounded corners.

    With c_i the positive part of the cosine between a direction and the middle of side i, and p the sharpness, the
    distance from the axis is (sum of c_i^p)^(-1/p): four sides give a superellipse, and p = infinity the polygon.
    """

    sides: int
    sharpness: float
    turn: float
    """Direction of the middle of a side, in radians from the first vector perpendicular to the axis."""

    def factors(self, angles: Float[np.ndarray, "*angle"]) -> Float64[np.ndarray, "*angle"]:
        """Distance from the axis in these directions, relative to the middle of a side."""
        at_side = self._sum(np.array([self.turn]))
        return (self._sum(angles) / at_side) ** (-1 / self.sharpness)

    def looked_up(self, angles: Float[np.ndarray, "*angle"], heights: np.ndarray) -> Float64[np.ndarray, "*angle"]:  # noqa: ARG002
        """The same for many directions, by a table; at all heights alike."""
        place = (angles % (2 * np.pi)) * (TABLE / (2 * np.pi))
        return self.factors(_UNIT)[np.rint(place).astype(np.int32)]

    def slopes(self, angles: Float[np.ndarray, "*angle"]) -> Float64[np.ndarray, "*angle"]:
        """Derivatives of `factors`, per radian."""
        cos, sin = self._towards(angles)
        return self.factors(angles) * (cos ** (self.sharpness - 1) * sin).sum(axis=-1) / self._sum(angles)

    def spread(self, count: int) -> Float64[np.ndarray, " angle"]:
        """Directions of points around the section, half of them for its way around, half for the turns of its
        normals, so that corners are round."""
        normals = _UNIT - np.arctan2(self.slopes(_UNIT), self.factors(_UNIT))
        way = (_UNIT + normals) / 2
        way -= way[0]
        return np.interp(np.arange(count) * (2 * np.pi / count), way, _UNIT)

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
