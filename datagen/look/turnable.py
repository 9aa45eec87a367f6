"""Drawings in space as inline SVG: a picture without scripts, and one that can be turned where scripts run."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.pages.html import Markup, Part, tag

SIDE = 420
"""Units of the drawing's side."""
AZIMUTH_DEG, ELEVATION_DEG = -50.0, 30.0
"""From where it is seen at first: from the right in front, and above. pages/turn.js turns it from there."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stroke:
    """A line through points in the world, or the points alone."""

    points: Float[np.ndarray, "point 3"]
    """Metres, +z up."""
    says: str = ""
    """What appears when one points at it."""
    style: str = ""
    """Class of the style sheet; empty: `color` counts."""
    color: str = "currentColor"
    are_dots: bool = False
    is_faint: bool = False


def draw_turnable(strokes: list[Stroke], name: str, around: Float[np.ndarray, "point 3"]) -> Markup:
    """The drawing of these strokes.

    Args:
        around: points that are to be seen from any side, as large as the frame allows; what lies farther out is cut.
    """
    middle = (around.min(axis=0) + around.max(axis=0)) / 2
    scale = (SIDE / 2 - 6) / max(float(np.linalg.norm(around - middle, axis=1).max()), 1e-9)
    parts: list[Part] = [tag("title", name)]
    for stroke in strokes:
        placed = ((stroke.points - middle) * scale).round(1)
        path = tag(
            "path",
            d=path_of(placed, are_dots=stroke.are_dots),
            stroke=None if stroke.style or stroke.are_dots else stroke.color,
            data_points=" ".join(f"{value:g}" for value in placed.ravel()),
            data_dots=stroke.are_dots,
        )
        said = tag("title", stroke.says) if stroke.says else None
        kind = "points" if stroke.are_dots else "stroke faint" if stroke.is_faint else "stroke"
        parts.append(tag("g", said, path, class_=f"{kind} {stroke.style}".strip()))
    return tag(
        "svg",
        *parts,
        class_="chart turnable",
        viewBox=f"{-SIDE / 2:g} {-SIDE / 2:g} {SIDE} {SIDE}",
        role="img",
        aria_label=name,
        data_azimuth=f"{AZIMUTH_DEG:g}",
        data_elevation=f"{ELEVATION_DEG:g}",
    )


def path_of(placed: Float[np.ndarray, "point 3"], *, are_dots: bool) -> str:
    """The path of points around the origin, seen along parallel rays; pages/turn.js does the same."""
    azimuth, elevation = math.radians(AZIMUTH_DEG), math.radians(ELEVATION_DEG)
    x, y, z = placed.T
    across = y * math.cos(azimuth) - x * math.sin(azimuth)
    towards = x * math.cos(azimuth) + y * math.sin(azimuth)
    down = towards * math.sin(elevation) - z * math.cos(elevation)
    places = [f"{right:.1f} {below:.1f}" for right, below in zip(across, down, strict=True)]
    return "".join(f"M{place}h0" for place in places) if are_dots else "M" + "L".join(places)
