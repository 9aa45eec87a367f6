"""Upright boxes and sheets over rectangles, which may be at an angle to the axes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.meshes import Mesh
from datagen.scene.modelling import moved, rotation, rounded_box, sheet, transformed

Flat = Float[np.ndarray, "_ 2"]


@dataclass(frozen=True, kw_only=True)
class Rectangle:
    """A rectangle in the plane, at an angle to the axes."""

    center: tuple[float, float]
    half: tuple[float, float]
    angle: float
    """Radians from +x towards +y."""

    @property
    def axes(self) -> Float[np.ndarray, "2 2"]:
        """Unit vectors along its sides, as rows."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.array([[c, s], [-s, c]])

    def holds(self, flat: Flat, *, margin: float = 0.0) -> Bool[np.ndarray, "_"]:
        """True for points in it."""
        return np.all(np.abs((flat - self.center) @ self.axes.T) <= np.array(self.half) + margin, axis=1)

    def sheet(self, height: float) -> Mesh:
        """It, facing up."""
        along, across = self.axes * np.array(self.half)[:, None]
        corner = np.array(self.center) - along - across
        return sheet((*corner, height), (*(2 * along), 0), (*(2 * across), 0))


def smallest_rectangle(flat: Flat, percent: float = 2.0, angle: float | None = None) -> Rectangle:
    """The smallest rectangle around all points but few."""
    angles = np.radians(np.arange(0, 90, 2)) if angle is None else [angle]
    best = None
    for turn in angles:
        c, s = np.cos(turn), np.sin(turn)
        axes = np.array([[c, s], [-s, c]])
        low, high = np.percentile(flat @ axes.T, (percent, 100 - percent), axis=0)
        if best is None or np.prod(high - low) < np.prod(2 * np.array(best.half)):
            center = (low + high) / 2 @ axes
            best = Rectangle(center=tuple(center), half=tuple((high - low) / 2), angle=float(turn))
    assert best is not None
    return best


def box_on(base: Rectangle, low: float, high: float) -> Mesh:
    """A box over a rectangle."""
    size = (2 * base.half[0], 2 * base.half[1], high - low)
    box = rounded_box(size, bevel=0.02 * min(size), segments=1)
    turned = transformed(box, rotation((0, 0, 1), float(np.degrees(base.angle))), (0, 0, 0))
    return moved(turned, (*base.center, (low + high) / 2))
