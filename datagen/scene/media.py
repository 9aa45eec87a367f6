"""The media that light passes through: which solid fills a point inside several, and its optics.

Nested dielectrics by priority: every mesh stays closed, and a drink extends slightly into the wall of its glass. Where
solids overlap, the one of the lowest rank fills the space, and the surfaces of the others do not exist there.
Source: Schmidt and Budge 2002, "Simple Nested Dielectrics in Ray Traced Images".

A kernel carries, with each ray, the `solids` that it is in: a UInt32 that starts as `no_solids(media)` in air and is
changed only by `with_solid` and `without_solid`. At a surface of rank `rank`, whichever way the ray crosses it,

    inner = medium_of(media, with_solid(media, solids, rank))
    outer = medium_of(media, without_solid(media, solids, rank))

are the media on its two sides, and nothing happens if they are the same. This does not depend on whether the ray was in
the solid, so a ray that slipped through an edge is corrected at the next surface of that solid.
"""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false, reportReturnType=false

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32, Int32

from datagen.data.meshes import Mesh
from datagen.scene.materials import Material

if TYPE_CHECKING:
    import mitsuba as mi

SAME_INDEX = 1e-6
"""A surface does not tint if the ratio of indices is this close to 1: overlapping parts of one glass have no surface
between them."""
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
        is_nested = len(order) <= MAX_NESTED and _boxes_meet([meshes[index] for index in order])
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


def _boxes_meet(meshes: list[Mesh]) -> bool:
    if len(meshes) < 2:
        return False
    low, high = (np.stack([bound(mesh.vertices, axis=0) for mesh in meshes]) for bound in (np.min, np.max))
    meets = ((low[:, None] <= high) & (low <= high[:, None])).all(axis=-1)
    return bool(meets.sum() > len(meshes))
