"""What bounds the light paths of a ray: how many branches, how long, and how much of them is kept."""

from typing import NamedTuple


class Limits(NamedTuple):
    """What bounds the light paths of a ray."""

    max_branches: int = 4
    """Followed for each ray; 1 is the refracted one alone."""
    max_vertices: int = 8
    """Kept of each branch. The last place holds the last vertex, however many come before it."""
    max_depth: int = 24
    """Surfaces after which a branch is given up."""


LIMITS = Limits()
"""Those of a tracer that is told none."""
