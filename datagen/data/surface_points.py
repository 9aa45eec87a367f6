"""Points that are spread evenly: on a mesh by area, and in the unit square; the same ones every time."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from datagen.data.meshes import Mesh, face_areas, face_corners

PLASTIC = 1.32471795724474602596
"""The plastic number, on which the R2 sequence is based."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfacePoints:
    """Points on a mesh and the faces that they lie on."""

    face: Int[np.ndarray, " point"]
    position: Float[np.ndarray, "point 3"]


def points_on(
    mesh: Mesh, count: int, *, part: Int[np.ndarray, " face"] | None = None, count_a_part: int = 0
) -> SurfacePoints:
    """So many points on the whole mesh, then so many on each of its parts.

    Args:
        part: of each face, counted from 0.
    """
    rng = np.random.default_rng(0)
    part = np.zeros(len(mesh.faces), np.int64) if part is None else part
    order = np.argsort(part, kind="stable")
    ends = np.cumsum(face_areas(mesh)[order])
    high = ends[np.searchsorted(part[order], np.arange(part.max() + 1), side="right") - 1]
    low = np.concatenate([[0.0], high[:-1]])
    on_parts = low + (high - low) * rng.random((count_a_part, len(high)))
    place = np.concatenate([ends[-1] * rng.random(count), on_parts.reshape(-1)])
    face = order[np.minimum(np.searchsorted(ends, place), len(order) - 1)]
    weights = rng.dirichlet([1.0, 1.0, 1.0], size=len(face))
    corners = face_corners(mesh)[face].astype(np.float64)
    return SurfacePoints(face=face, position=np.einsum("pk,pkc->pc", weights, corners))


def r2_steps(count: int) -> Float[np.ndarray, "point 2"]:
    """Points of the R2 sequence before the modulo: their fractional parts cover the unit square evenly for any count.

    Source: Roberts 2018, "The Unreasonable Effectiveness of Quasirandom Sequences".
    """
    return np.arange(count)[:, None] / PLASTIC ** np.arange(1, 3)
