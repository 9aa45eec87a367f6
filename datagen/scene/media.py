"""The media that light passes through: which solid fills a point inside several, and where rays leave a surface.

Nested dielectrics by priority: every mesh stays closed, and a drink extends slightly into the wall of its glass. Where
solids overlap, the one of the lowest rank fills the space, and the surfaces of the others do not exist there.
Source: Schmidt and Budge 2002, "Simple Nested Dielectrics in Ray Traced Images".

A kernel carries, with each ray, the `solids` that it is in: a UInt32 that starts as `no_solids(media)` in air. At a
surface, the media of `with_solid` and `without_solid` are on its two sides, and nothing happens if they are the same.
This does not depend on whether the ray was in the solid: one that slipped through an edge is corrected at the next
surface of that solid.
"""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false, reportReturnType=false

from dataclasses import dataclass
from itertools import combinations, starmap
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from datagen.data.meshes import Mesh, boxes_meet
from datagen.scene.materials import Material

if TYPE_CHECKING:
    import mitsuba as mi

SAME_INDEX = 1e-6
"""A surface does not tint if the ratio of indices is this close to 1: parts of one glass may overlap."""
MAX_NESTED = 32
"""Largest number of dielectrics in a scene with priorities: a ray keeps one bit for each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Media:
    """The dielectrics of a scene in the order in which they fill space, and air."""

    rank: Int32[np.ndarray, "object"]
    """Rank of each object among the dielectrics: 0 displaces all others, -1 is not a dielectric."""
    iors: Float32[np.ndarray, "medium 3"]
    """Index of refraction by rank and colour channel; air is last."""
    absorption: Float32[np.ndarray, "medium 3"]
    """Absorption coefficient in 1/m by rank; air, with 0, is last."""
    is_nested: bool
    """Whether a ray may be in several solids at once. If not, leaving any of them leads into air."""

    @property
    def ior(self) -> Float32[np.ndarray, " medium"]:
        """Index of refraction for yellow-green light, by rank."""
        return np.ascontiguousarray(self.iors[:, 1])

    @property
    def parts_colors(self) -> Bool[np.ndarray, " medium"]:
        """Whether a medium disperses (its channels have different indices), by rank."""
        return (self.iors != self.iors[:, :1]).any(axis=1)


def find_media(
    materials: tuple[Material | None, ...], meshes: tuple[Mesh, ...], *, is_nested: bool | None = None
) -> Media:
    """The media of a scene's objects. Unless `is_nested` says so, solids are nested if their bounding boxes overlap.

    More than MAX_NESTED dielectrics count as separate: `check_scene` rejects priorities then.
    """
    found = {index: material.medium for index, material in enumerate(materials) if material is not None}
    glass = {index: medium for index, medium in found.items() if medium is not None}
    order = sorted(glass, key=lambda index: (-glass[index].priority, index))
    if is_nested is None:
        pairs = combinations([meshes[index] for index in order], 2)
        is_nested = len(order) <= MAX_NESTED and any(starmap(boxes_meet, pairs))
    rank = np.full(len(materials), -1, np.int32)
    rank[order] = np.arange(len(order))
    # For an empty set of solids, the count of trailing zeros is the index of air.
    count = MAX_NESTED + 1 if is_nested else len(order) + 1
    iors, absorption = np.ones((count, 3), np.float32), np.zeros((count, 3), np.float32)
    for place, index in enumerate(order):
        iors[place], absorption[place] = glass[index].iors, glass[index].absorption
    return Media(rank=rank, iors=iors, absorption=absorption, is_nested=is_nested)


def no_solids(media: Media) -> int:
    """The solids of a ray in air."""
    return 0 if media.is_nested else len(media.ior) - 1


def with_solid(media: Media, solids: "mi.UInt32", rank: "mi.UInt32") -> "mi.UInt32":
    """The solids of a ray after entering the one of this rank; rank below MAX_NESTED in all lanes."""
    import mitsuba as mi

    return solids | (mi.UInt32(1) << rank) if media.is_nested else mi.UInt32(rank)


def without_solid(media: Media, solids: "mi.UInt32", rank: "mi.UInt32") -> "mi.UInt32":
    """The solids of a ray after leaving the one of this rank; rank below MAX_NESTED in all lanes."""
    import mitsuba as mi

    return solids & ~(mi.UInt32(1) << rank) if media.is_nested else mi.UInt32(no_solids(media))


def medium_of(media: Media, solids: "mi.UInt32") -> "mi.UInt32":
    """The index, in `ior` and `absorption`, of the medium at a point in these solids."""
    import drjit as dr

    return dr.tzcnt(solids) if media.is_nested else solids


def solids_around(
    media: Media, ranks: "mi.Int32", solids: "mi.UInt32", shape: "mi.ShapePtr", hit: "mi.Bool"
) -> tuple["mi.Bool", "mi.UInt32", "mi.UInt32"]:
    """Whether a shape is glass, and the solids on its inner and outer side, where `hit`.

    Args:
        ranks: by Dr.Jit's number of a shape; -1 for what is not glass.
    """
    import drjit as dr
    import mitsuba as mi

    rank = dr.gather(mi.Int32, ranks, dr.reinterpret_array(mi.UInt32, shape), hit)
    is_glass = hit & (rank >= 0)
    rank = mi.UInt32(dr.maximum(rank, 0))
    return is_glass, with_solid(media, solids, rank), without_solid(media, solids, rank)


# Where rays start. A ray that leaves a surface must not hit it again, but must hit the other face of a thin wall. So it
# starts off the surface, along the face's normal, by slightly more than rounding can move it. Let u = 2^-23, the last
# place of 1, and L the largest coordinate of an object:
#
# - A hit is a weighted mean of its face's corners. An error in the weights moves it within the face; rounding moves it
#   off the face by up to 1.5 u L. The ray's origin has no influence.
# - The next intersection subtracts the ray's origin from the corners, for another error of about u L.
#
# Of rays that left boxes, balls, slender cylinders and ground planes, up to 5 % hit their own face again after starting
# u L off it, none after 2 u L; RAY_OFFSET is twice that. An offset by each hit's own coordinates, as in Waechter and
# Binder (*Ray Tracing Gems*, chapter 6), is too small near the origin on large faces.
#
# So walls must be thicker than 8 u L, and than 4 u of the length of the rays that hit them: a micrometre near the
# origin, a tenth of a millimetre 100 m away. Thinner ones are lost, unchecked.


LAST_PLACE = 2.0**-23
"""The last place of 1 in float32."""

RAY_OFFSET = 4 * LAST_PLACE
"""Distance off its surface at which a ray starts, relative to the object's largest coordinate."""

SKIP_COSINE = 0.01
"""Cosines below this count as this for the length that a grazing ray skips."""


def largest_coordinate(points: Float[np.ndarray, "point 3"]) -> float:
    """The largest absolute coordinate on any axis."""
    return float(np.abs(points).max())


def skipped_length(offset: "mi.Float", cosine: "mi.Float") -> "mi.Float":
    """Metres inside a wall that a ray skips by starting off its other face; it hits this face at a cosine."""
    import drjit as dr

    return offset / dr.maximum(dr.abs(cosine), SKIP_COSINE)
