"""The media that light runs through: which solid fills a point that several share, and what it does to light.

Nested dielectrics by priority: every mesh stays closed, and a drink reaches a little into the wall of its glass. Where
solids overlap, the one of the lowest rank fills the space; there the surfaces of the others do not exist.
Source: Schmidt and Budge 2002, "Simple Nested Dielectrics in Ray Traced Images".

A kernel carries, with each ray, the `solids` that it is in: a UInt32 that starts as `no_solids(media)` in air and is
changed by `with_solid` and `without_solid` alone. At a surface of rank `rank`, whichever way the ray crosses it,

    inner = medium_of(media, with_solid(media, solids, rank))
    outer = medium_of(media, without_solid(media, solids, rank))

are the media on its two sides, and nothing happens where they are the same. That does not ask whether the ray was in
the solid: so a ray that slipped through an edge is put right by the next surface of that solid.
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
"""How far the ratio of two indices may be from 1 for there to be no surface that tints: overlapping parts of one glass
have none between them."""
MAX_NESTED = 32
"""How many dielectrics a scene with priorities may have: a ray keeps one bit for each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Media:
    """The dielectrics of a scene in the order in which they fill space, and air."""

    rank: Int32[np.ndarray, "object"]
    """Place of each object among the dielectrics: 0 for the one that displaces all others; -1 for no dielectric."""
    iors: Float32[np.ndarray, "medium 3"]
    """Index of refraction by rank and colour channel; that of air stands last."""
    absorption: Float32[np.ndarray, "medium 3"]
    """1/m by rank; that of air, 0, stands last."""
    is_nested: bool
    """Whether a ray may be in several solids at once. If not, to leave any of them is to come into air."""

    @property
    def ior(self) -> Float32[np.ndarray, " medium"]:
        """Index of refraction by rank, of yellow-green light."""
        return np.ascontiguousarray(self.iors[:, 1])

    @property
    def parts_colors(self) -> Bool[np.ndarray, " medium"]:
        """By rank: channels have different indices (dispersion)."""
        return (self.iors != self.iors[:, :1]).any(axis=1)


def find_media(materials: tuple[Material | None, ...], meshes: tuple[Mesh, ...]) -> Media:
    """The media of a scene's objects. Solids count as nested when their bounding boxes meet.

    More than MAX_NESTED dielectrics count as apart: `check_scene` refuses priorities then.
    """
    found = {index: material.medium for index, material in enumerate(materials) if material is not None}
    glass = {index: medium for index, medium in found.items() if medium is not None}
    order = sorted(glass, key=lambda index: (-glass[index].priority, index))
    is_nested = len(order) <= MAX_NESTED and _boxes_meet([meshes[index] for index in order])
    rank = np.full(len(materials), -1, np.int32)
    rank[order] = np.arange(len(order))
    # In a set of solids, air is what the count of trailing zeros gives for none.
    count = MAX_NESTED + 1 if is_nested else len(order) + 1
    iors, absorption = np.ones((count, 3), np.float32), np.zeros((count, 3), np.float32)
    for place, index in enumerate(order):
        iors[place], absorption[place] = glass[index].iors, glass[index].absorption
    return Media(rank=rank, iors=iors, absorption=absorption, is_nested=is_nested)


def no_solids(media: Media) -> int:
    """The solids that a ray in air is in."""
    return 0 if media.is_nested else len(media.ior) - 1


def with_solid(media: Media, solids: "mi.UInt32", rank: "mi.UInt32") -> "mi.UInt32":
    """The solids of a ray that has come into the one of this rank; rank below MAX_NESTED in all lanes."""
    import mitsuba as mi

    return solids | (mi.UInt32(1) << rank) if media.is_nested else mi.UInt32(rank)


def without_solid(media: Media, solids: "mi.UInt32", rank: "mi.UInt32") -> "mi.UInt32":
    """The solids of a ray that has left the one of this rank; rank below MAX_NESTED in all lanes."""
    import mitsuba as mi

    return solids & ~(mi.UInt32(1) << rank) if media.is_nested else mi.UInt32(no_solids(media))


def medium_of(media: Media, solids: "mi.UInt32") -> "mi.UInt32":
    """The place, in `ior` and `absorption`, of what fills a point that is in these solids."""
    import drjit as dr

    return dr.tzcnt(solids) if media.is_nested else solids


def _boxes_meet(meshes: list[Mesh]) -> bool:
    if len(meshes) < 2:
        return False
    low, high = (np.stack([bound(mesh.vertices, axis=0) for mesh in meshes]) for bound in (np.min, np.max))
    meets = ((low[:, None] <= high) & (low <= high[:, None])).all(axis=-1)
    return bool(meets.sum() > len(meshes))
