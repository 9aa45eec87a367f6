"""How well a shape agrees with masks: each ray at a mask's edge is one sample of a logistic regression."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy import special

from datagen.data.meshes import Mesh
from hyaline_photos.fit.views import NearRays

WRONG = 0.01
"""Expected share of wrong pixels at a mask's edge; pixels that a shape cannot explain have little say."""


LEAST_DAMPING = 1e-6
"""Share of the curvature that is added to itself; where rays do not tell two numbers apart, it is singular without."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pull:
    """Derivatives of the misfit by the rays' distances from a shape."""

    slope: Float64[np.ndarray, " ray"]
    curvature: Float64[np.ndarray, " ray"]
    """An upper bound far away, where Newton's steps would be too long."""


def errors(distance: Float64[np.ndarray, " ray"], hits: Bool[np.ndarray, " ray"]) -> Float64[np.ndarray, " ray"]:
    """By how many metres rays are on the wrong side of a surface; negative on the right one.

    Args:
        distance: least signed distance from the shape along each ray, negative inside.
        hits: whether the mask covers the ray.
    """
    return np.where(hits, distance, -distance)


def misfit(
    distance: Float64[np.ndarray, " ray"], hits: Bool[np.ndarray, " ray"], width: float | Float[np.ndarray, " ray"]
) -> float:
    """Mean negative logarithm of the likelihood of the masks.

    Args:
        width: metres over which a ray turns from meeting the shape to missing it.
    """
    right = special.expit(-errors(distance, hits) / width)
    return float(-np.log(WRONG + (1 - 2 * WRONG) * right).mean())


def pull(
    distance: Float64[np.ndarray, " ray"], hits: Bool[np.ndarray, " ray"], width: float | Float[np.ndarray, " ray"]
) -> Pull:
    """Derivatives of `misfit`, times the number of rays."""
    error = errors(distance, hits) / width
    wrong = special.expit(error)
    # Of pixels on the wrong side by much, the mask is in doubt, not the shape.
    trust = (1 - WRONG) * (1 - wrong) / (WRONG + (1 - 2 * WRONG) * (1 - wrong))
    bound = np.where(error > 1e-3, (wrong - 0.5) / np.maximum(error, 1e-3), wrong * (1 - wrong))
    return Pull(slope=np.where(hits, 1, -1) * trust * wrong / width, curvature=trust * bound / width**2)


def closest(
    distance: Callable[[Float64[np.ndarray, "ray place"]], Float64[np.ndarray, "ray place"]],
    low: Float64[np.ndarray, " ray"],
    high: Float64[np.ndarray, " ray"],
    counts: Sequence[int],
) -> Float64[np.ndarray, " ray"]:
    """Metres along rays at which a distance is least.

    Args:
        distance: at places along each ray, by these metres.
        low: where the search begins.
        high: where it ends.
        counts: places at which each ray is looked at, first between both ends, then around the best place.
    """
    found, row = low, np.arange(len(low))
    for count in counts:
        t = np.linspace(low, high, count, axis=1)
        best = distance(t).argmin(axis=1)
        low, found, high = (t[row, np.clip(best + side, 0, count - 1)] for side in (-1, 0, 1))
    return found


Shape = TypeVar("Shape")
Passes = TypeVar("Passes")


def descend(
    shape: Shape,
    judge: Callable[[Shape], tuple[float, Passes]],
    step: Callable[[Shape, Passes, float], Shape],
    *,
    damping: float,
    steps: int,
    enough: float,
) -> tuple[Shape, float]:
    """The shape after damped Newton steps, and its misfit.

    Args:
        judge: the misfit of a shape, and how rays pass it.
        step: the shape after one step, from how rays pass it and the damping.
        damping: the first one.
        steps: the largest number of steps.
        enough: the steps end when one gains less, relative to the misfit.
    """
    loss, passes = judge(shape)
    for _ in range(steps):
        tried = step(shape, passes, damping)
        new, new_passes = judge(tried)
        if new < loss:
            gain, shape, loss, passes = loss - new, tried, new, new_passes
            damping = max(damping / 4, LEAST_DAMPING)
            if gain < enough * loss:
                break
        elif damping > 1e3:
            break
        else:
            damping *= 8
    return shape, loss


def contradictions(mesh: Mesh, rays: NearRays) -> Bool[np.ndarray, " edge"]:
    """Which of the rays at a mask's edge meet a mesh and should miss it, or the other way round.

    Where the mask shows the object, a known surface in front of it is misplaced, as parts of a fitted room are, and
    does not count.
    """
    from datagen.trace.peel import Peeler

    edge = rays.at_edges()
    hits = Peeler((mesh,)).trace(edge.origins.astype(np.float32), edge.directions.astype(np.float32), 1)
    meets = (hits.shape[0] >= 0) & (edge.hits | (hits.t[0] < edge.reach))
    return meets != edge.hits


def unexplained(mesh: Mesh, rays: NearRays) -> float:
    """Share of the rays at a mask's edge that contradict a mesh: the same for shapes of all kinds."""
    return float(contradictions(mesh, rays).mean())
