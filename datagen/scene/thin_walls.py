"""How far off a surface rays start, and the solid walls that are too thin for float32.

A ray that leaves a surface must not meet it again, but must meet the other face of a thin wall. So it starts off the
surface, along the face's normal, by a little more than rounding can move it. Let u = 2^-23, the last place of 1, and L
the largest coordinate of an object:

- A hit is found as a weighted mean of its face's corners. An error in the weights moves it within the face; rounding
  moves it off the face by up to 1.5 u L. Where the ray came from does not count.
- The next intersection subtracts the ray's origin from the corners, for another error of about u L.

Of rays that left boxes, balls, slender cylinders and ground planes, turned and not, at the origin and 100 m away, up to
5 % (an axis-aligned box; mostly below 0.1 %) met their own face again after starting u L off it, and none after 2 u L.
RAY_OFFSET is twice that. An offset that follows each hit's own coordinates, as in Waechter and Binder (*Ray Tracing
Gems*, chapter 6), is too small near the origin on large faces: 0.1 % of the rays from a tilted 200 m square met it
again.

A wall must be thicker than that offset with its errors: 8 u L. And a ray from far away must meet the near face before
the far one: at 1 u of the ray's length, 1 % of rays took the wrong one, at 2 u none; walls must have 4 u.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    import mitsuba as mi

LAST_PLACE = 2.0**-23
"""Of 1 in float32."""

RAY_OFFSET = 4 * LAST_PLACE
"""How far off its surface a ray starts, relative to the largest coordinate of the object."""

MIN_COSINE = 0.01
"""Where a ray grazes a face, it skips as much as at this cosine."""


def largest_coordinate(points: Float[np.ndarray, "point 3"]) -> float:
    """Distance from the world's origin along the axis on which it is largest."""
    return float(np.abs(points).max())


def thinnest_wall(reach: float, distance: float) -> float:
    """Metres that the walls of a solid need at least.

    Args:
        reach: the solid's largest coordinate.
        distance: from where rays come to it, at most.
    """
    return LAST_PLACE * max(8 * reach, 4 * distance)


def skipped_length(offset: "mi.Float", cosine: "mi.Float") -> "mi.Float":
    """Metres inside a wall that a ray skips which starts off its other face, and meets this one at a cosine."""
    import drjit as dr

    return offset / dr.maximum(dr.abs(cosine), MIN_COSINE)
