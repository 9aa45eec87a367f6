"""Cross sections of what a lathe sweeps: polygons, soft squares, flutes and stars instead of circles."""

import numpy as np

from datagen.scene.modelling import Around, Mesh, Points, deformed

ROUND = 96
"""Points around a section that has no corners."""


def polygon(sides: int) -> Around:
    """A regular polygon whose flat sides have the outline's radius; a corner is at angle 0."""
    step = 2 * np.pi / sides

    def factors(angles: np.ndarray, outline: np.ndarray) -> np.ndarray:
        return np.tile(1 / np.cos(angles % step - step / 2), (len(outline), 1))

    return factors


def soft_square(power: float) -> Around:
    """A square with round corners (a superellipse): a circle at power 2, sharper with more."""

    def factors(angles: np.ndarray, outline: np.ndarray) -> np.ndarray:
        sums = np.abs(np.cos(angles)) ** power + np.abs(np.sin(angles)) ** power
        return np.tile(sums ** (-1 / power), (len(outline), 1))

    return factors


def flutes(count: int, depth: float) -> Around:
    """Round ribs with narrow grooves between them; `depth` is a share of the radius."""

    def factors(angles: np.ndarray, outline: np.ndarray) -> np.ndarray:
        ribs = np.abs(np.sin(count * angles / 2))
        return np.tile(1 - depth * (1 - ribs), (len(outline), 1))

    return factors


def star(points: int, depth: float) -> Around:
    """Waves around the axis, like a star with soft points; `depth` is a share of the radius."""

    def factors(angles: np.ndarray, outline: np.ndarray) -> np.ndarray:
        return np.tile(1 - depth * (0.5 - 0.5 * np.cos(points * angles)), (len(outline), 1))

    return factors


def outside_only(around: Around, count: int, *, low: float, high: float) -> Around:
    """The section for the first `count` points of an outline, where their height is between `low` and `high`.

    So the outside of a vessel is cut and its inside stays round. The cut fades over a tenth of the height at both ends.
    """
    fade = 0.1 * (high - low)

    def factors(angles: np.ndarray, outline: np.ndarray) -> np.ndarray:
        height = outline[:, 1]
        share = np.clip(np.minimum(height - low, high - height) / fade, 0, 1)
        share = np.where(np.arange(len(outline)) < count, share, 0.0)[:, None]
        return 1 + share * (around(angles, outline) - 1)

    return factors


def corners_of(sides: int) -> int:
    """Points around a polygon: its corners are among them."""
    return sides * max(1, round(ROUND / sides))


def twisted(mesh: Mesh, turns_per_metre: float, *, crease_deg: float) -> Mesh:
    """The mesh turned about z the more, the higher it is."""

    def turn(p: Points) -> Points:
        angle = 2 * np.pi * turns_per_metre * p[:, 2]
        cos, sin = np.cos(angle), np.sin(angle)
        return np.stack([cos * p[:, 0] - sin * p[:, 1], sin * p[:, 0] + cos * p[:, 1], p[:, 2]], axis=-1)

    return deformed(mesh, turn, crease_deg=crease_deg)
