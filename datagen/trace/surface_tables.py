"""What a kernel looks up of a scene's surfaces: by object its optics, by face the corners."""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.materials import Material
from datagen.scene.materials.optics import Event, Surface
from datagen.scene.media import Media
from datagen.scene.thin_walls import RAY_OFFSET, largest_coordinate
from datagen.trace.tints import Tints, make_tint_tables

if TYPE_CHECKING:
    import mitsuba as mi

OPAQUE, DIELECTRIC, THIN, COATED, METAL = range(5)
"""What a surface does to a ray, as numbers in the kernel."""

EVENTS: dict[Event, int] = {
    "ends": OPAQUE,
    "refracts": DIELECTRIC,
    "passes": THIN,
    "coated": COATED,
    "mirrors": METAL,
}

NO_SURFACE = Surface(event="passes", ior=1.0)
"""A pane of air, for straight layers."""


class SurfaceTables(NamedTuple):
    """What the kernel looks up: by object its optics, by face its corners' positions, normals and uv."""

    kind: "mi.UInt32"
    coat_ior: "mi.Float"
    roughness: "mi.Float"
    color: "list[mi.Float]"
    offset: "mi.Float"
    """How far off its surface a ray starts."""
    rank: "mi.Int32"
    medium_ior: "mi.Float"
    """Of the colour channel whose paths are followed."""
    parts_colors: "mi.Bool"
    """By medium."""
    absorption: "list[mi.Float]"
    first_face: "mi.UInt32"
    positions: "mi.Float"
    normals: "mi.Float"
    uv: "mi.Float"
    has_rough_glass: bool
    disperses: bool
    """Some medium parts colours."""
    tints: tuple | None
    """Those of `TintTables`, a plain tuple: a frozen function of Dr.Jit looks into no other."""


def make_tables(
    meshes: tuple[Mesh, ...], materials: tuple[Material | None, ...], media: Media, tints: Tints
) -> SurfaceTables:
    """The tables of a scene's objects; a surface without material is a pane of air."""
    import mitsuba as mi

    def array(values: list[float]) -> "mi.Float":
        return mi.Float(np.array(values, np.float32))

    def corners(values: list[np.ndarray]) -> "mi.Float":
        return mi.Float(np.concatenate(values).ravel())

    tint_tables = make_tint_tables(tints)
    surfaces = [NO_SURFACE if material is None else material.surface() for material in materials]
    first_face = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])[:-1]
    return SurfaceTables(
        kind=mi.UInt32(np.array([EVENTS[surface.event] for surface in surfaces], np.uint32)),
        coat_ior=array([surface.ior for surface in surfaces]),
        roughness=array([surface.roughness for surface in surfaces]),
        color=[array([surface.color[c] for surface in surfaces]) for c in range(3)],
        offset=array([RAY_OFFSET * largest_coordinate(mesh.vertices) for mesh in meshes]),
        rank=mi.Int32(media.rank),
        medium_ior=mi.Float(media.ior),
        parts_colors=mi.Bool(media.parts_colors),
        absorption=[mi.Float(np.ascontiguousarray(media.absorption[:, c])) for c in range(3)],
        first_face=mi.UInt32(first_face.astype(np.uint32)),
        positions=corners([mesh.vertices[mesh.faces] for mesh in meshes]),
        normals=corners([mesh.normals[mesh.faces] for mesh in meshes]),
        uv=corners([mesh.uv[mesh.faces] for mesh in meshes]),
        has_rough_glass=any(surface.event == "refracts" and surface.roughness > 0 for surface in surfaces),
        disperses=bool(media.parts_colors.any()),
        tints=None if tint_tables is None else tuple(tint_tables),
    )
