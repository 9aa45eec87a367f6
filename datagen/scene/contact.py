"""How close surfaces may come: where rays start, which walls are too thin for float32, which surfaces coincide.

A ray that leaves a surface must not hit it again, but must hit the other face of a thin wall. So it starts off the
surface, along the face's normal, by slightly more than rounding can move it. Let u = 2^-23, the last place of 1, and L
the largest coordinate of an object:

- A hit is a weighted mean of its face's corners. An error in the weights moves it within the face; rounding moves it
  off the face by up to 1.5 u L. The ray's origin has no influence.
- The next intersection subtracts the ray's origin from the corners, for another error of about u L.

Of rays that left boxes, balls, slender cylinders and ground planes, rotated or not, at the origin and 100 m away, up
to 5 % (an axis-aligned box; mostly below 0.1 %) hit their own face again after starting u L off it, none after 2 u L.
RAY_OFFSET is twice that. An offset that depends on each hit's own coordinates, as in Waechter and Binder (*Ray Tracing
Gems*, chapter 6), is too small near the origin on large faces: 0.1 % of the rays from a tilted 200 m square hit it
again.

So walls must be thicker than 8 u L, and than 4 u of the length of the rays that hit them, of which 1 % find the far
face first at 1 u: a micrometre near the origin, a tenth of a millimetre 100 m away. Thinner ones are lost, unchecked.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.meshes import Mesh, SurfacePoints, face_corners, points_on

if TYPE_CHECKING:
    import mitsuba as mi

LAST_PLACE = 2.0**-23
"""The last place of 1 in float32."""

RAY_OFFSET = 4 * LAST_PLACE
"""Distance off its surface at which a ray starts, relative to the object's largest coordinate."""

MIN_COSINE = 0.01
"""Cosines below this count as this for the length that a grazing ray skips."""


def largest_coordinate(points: Float[np.ndarray, "point 3"]) -> float:
    """The largest absolute coordinate on any axis."""
    return float(np.abs(points).max())


def skipped_length(offset: "mi.Float", cosine: "mi.Float") -> "mi.Float":
    """Metres inside a wall that a ray skips by starting off its other face; it hits this face at a cosine."""
    import drjit as dr

    return offset / dr.maximum(dr.abs(cosine), MIN_COSINE)


# Coincident surfaces lose layers, and glass vanishes there


TOLERANCE = 1e-4
"""Planes closer than this count as one, in metres: a gap of a tenth of a millimetre is never intended."""

SAMPLES = 1024
"""Points on a surface, spread by area, with which its contact is measured."""
SAMPLES_ON_FACES = 1 << 14
"""Further points, as many on each face and at least one, where it matters which faces touch."""


def touching_share(mesh: Mesh, other: Mesh, *, within: float = TOLERANCE, are_opposed: bool = False) -> float:
    """The share of a mesh's surface that lies in faces of another, measured at `SAMPLES` points.

    Args:
        within: distance in metres up to which it lies in them.
        are_opposed: only in faces with opposite normals: the meshes touch from outside.
    """
    found = _distances(mesh, other, within, points_on(mesh, SAMPLES), are_opposed=are_opposed)
    return float(np.isfinite(found).mean())


def touching_faces(mesh: Mesh, other: Mesh) -> Bool[np.ndarray, " face"]:
    """Which faces of a mesh lie in faces of another, at least in part."""
    every = np.arange(len(mesh.faces))
    sampled = points_on(mesh, SAMPLES, part=every, count_a_part=max(1, SAMPLES_ON_FACES // len(every)))
    return np.isin(every, sampled.face[np.isfinite(_distances(mesh, other, TOLERANCE, sampled))])


def _distances(
    mesh: Mesh, other: Mesh, limit: float, sampled: SurfacePoints, *, are_opposed: bool = False
) -> Float[np.ndarray, " sample"]:
    """Distance from points of a mesh to the plane of a parallel face that each is over; inf beyond `limit`.

    Args:
        are_opposed: the faces must have opposite normals.
    """
    distance = np.full(len(sampled.position), np.inf)
    (low, high), (other_low, other_high) = ((m.vertices.min(axis=0), m.vertices.max(axis=0)) for m in (mesh, other))
    if (low > other_high + limit).any() or (other_low > high + limit).any():
        return distance
    from scipy.spatial import KDTree

    corners = face_corners(other).astype(np.float64)
    corners = corners[_meets(corners, sampled.position)]
    if not len(corners):
        return distance
    normals, mine = _unit_normals(corners), _unit_normals(face_corners(mesh)[sampled.face].astype(np.float64))
    middle = (corners.max(axis=1) + corners.min(axis=1)) / 2
    radius = np.linalg.norm(corners - middle[:, None], axis=-1).max(axis=1) + limit
    tree = KDTree(sampled.position)
    counts = np.asarray(tree.query_ball_point(middle, radius, return_length=True))
    near = np.flatnonzero(counts)
    for piece in np.array_split(near, max(1, int(counts.sum()) >> 20)):
        if len(piece):
            found = tree.query_ball_point(middle[piece], radius[piece])
            point = np.concatenate([np.asarray(places, np.int64) for places in found])
            face = np.repeat(piece, counts[piece])
            # Faces with a parallel normal whose plane contains the point.
            height = np.abs(np.einsum("pc,pc->p", sampled.position[point] - corners[face, 0], normals[face]))
            near = height <= limit
            point, face, height = point[near], face[near], height[near]
            cosine = np.einsum("pc,pc->p", mine[point], normals[face])
            parallel = (-cosine if are_opposed else np.abs(cosine)) > 0.9
            point, face, height = point[parallel], face[parallel], height[parallel]
            is_over = _is_over(sampled.position[point], corners[face], normals[face])
            np.minimum.at(distance, point[is_over], height[is_over])
    return distance


def _meets(corners: Float[np.ndarray, "face 3 3"], points: Float[np.ndarray, "point 3"]) -> Bool[np.ndarray, " face"]:
    """Faces whose bounding box overlaps that of the points."""
    low, high = points.min(axis=0) - TOLERANCE, points.max(axis=0) + TOLERANCE
    return ((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=-1)


def _unit_normals(corners: Float[np.ndarray, "pair 3 3"]) -> Float[np.ndarray, "pair 3"]:
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _is_over(
    point: Float[np.ndarray, "pair 3"], corners: Float[np.ndarray, "pair 3 3"], normals: Float[np.ndarray, "pair 3"]
) -> Bool[np.ndarray, " pair"]:
    """Points whose projection on the face's plane is in the face."""
    is_over = np.ones(len(point), bool)
    for start in range(3):
        corner, following = corners[:, start], corners[:, (start + 1) % 3]
        is_over &= np.einsum("pc,pc->p", np.cross(normals, following - corner), point - corner) >= 0
    return is_over
