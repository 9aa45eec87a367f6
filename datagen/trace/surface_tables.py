"""Inputs of the light path kernel: limits, optics by object, corners by face, and the texels that tint metals."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float32

from datagen.data.meshes import Mesh, is_there
from datagen.render.albedo import albedo_table
from datagen.render.mitsuba_scene import linear_texels
from datagen.scene.description import Scene
from datagen.scene.materials import Event, Material, Surface
from datagen.scene.media import RAY_OFFSET, Media, largest_coordinate

if TYPE_CHECKING:
    import mitsuba as mi

Texels = Float32[np.ndarray, "tex_h tex_w 3"]
Tints = tuple[Texels | None, ...]
"""Texels by object; None for objects of one colour. Row 0 is on top, where v is 1."""


class Limits(NamedTuple):
    """Limits of a ray's light paths."""

    max_branches: int = 4
    """Branches followed for each ray; 1 is the refracted one alone."""
    max_vertices: int = 8
    """Vertices kept of each branch. The last place always contains the branch's last vertex."""
    max_depth: int = 100
    """Number of surfaces after which a branch is abandoned."""
    min_throughput: float = 1 / 512
    """Branches that start with a smaller throughput are not followed; less is below one step of an 8-bit picture."""
    makes_up: bool = False
    """Scale up the light at a ray's ends to make up for branches that were not followed, as if those showed the same.
    Light after `max_depth` surfaces is lost, as in truth."""


LIMITS = Limits()
"""The default limits."""


OPAQUE, DIELECTRIC, THIN, COATED, METAL = range(5)
"""Events at a surface, as numbers in the kernel."""

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
    """Lookup tables of the kernel: optics by object; positions, normals and uv of corners by face."""

    shape: "mi.UInt32"
    """Index of an object by the number that `id_of_shape` gives."""
    kind: "mi.UInt32"
    coat_ior: "mi.Float"
    """Index of refraction of coats, metals and panes."""
    roughness: "mi.Float"
    color: "list[mi.Float]"
    offset: "mi.Float"
    """Distance off its surface at which a ray starts, by object."""
    rank: "mi.Int32"
    medium_ior: "mi.Float"
    """Index of refraction by medium, in the colour channel whose paths are followed."""
    parts_colors: "mi.Bool"
    """Whether a medium disperses."""
    absorption: "list[mi.Float]"
    first_face: "mi.UInt32"
    positions: "mi.Float"
    normals: "mi.Float"
    uv: "mi.Float"
    has_rough_glass: bool
    disperses: bool
    """Whether some medium disperses."""
    albedo: "mi.Float"
    """`albedo_table`, flat."""
    tints: tuple | None
    """`TintTables` as a plain tuple: Dr.Jit's frozen functions accept no other kind here."""


def make_tables(
    shapes: "mi.UInt32",
    meshes: tuple[Mesh, ...],
    materials: tuple[Material | None, ...],
    media: Media,
    tints: Tints,
) -> SurfaceTables:
    """The tables of a scene's objects; a surface without material is a pane of air.

    Args:
        shapes: `SurfaceTables.shape`.
    """
    import mitsuba as mi

    def array(values: list[float]) -> "mi.Float":
        return mi.Float(np.array(values, np.float32))

    def corners(values: list[np.ndarray]) -> "mi.Float":
        return mi.Float(np.concatenate(values).ravel())

    tint_tables = make_tint_tables(tints)
    surfaces = [NO_SURFACE if material is None else material.surface() for material in materials]
    first_face = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])[:-1]
    return SurfaceTables(
        shape=shapes,
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
        albedo=mi.Float(albedo_table().ravel()),
        tints=None if tint_tables is None else tuple(tint_tables),
    )


# Tints: what metals mirror over their surface, where a texture describes it


class TintTables(NamedTuple):
    """The texels of all objects; an object without a texture has one white texel."""

    texels: "list[mi.Float]"
    """Texels by colour channel."""
    first: "mi.UInt32"
    """Index of an object's first texel, by object."""
    width: "mi.UInt32"
    height: "mi.UInt32"


def tints_of(scene: Scene, *, own_uv: bool) -> Tints:
    """The textures of a scene's metals.

    Args:
        own_uv: whether light is followed on the objects' own meshes. Proxies have other uv and get the mean colour.
    """
    tints: list[Texels | None] = []
    for item in scene.objects:
        texture = item.material.surface().texture
        if texture is None or not is_there(item.mesh):
            tints.append(None)
            continue
        texels = linear_texels(scene, item.mesh, texture)
        tints.append(texels if own_uv else _mean(texels, item.mesh))
    return tuple(tints)


def _mean(texels: Texels, mesh: Mesh) -> Texels:
    """The mean of the texels that a surface covers."""
    from datagen.scene.atlas import coverage

    size = 256
    rows, columns = ((np.arange(size) + 0.5) / size * side for side in texels.shape[:2])
    covered = texels[np.ix_(rows.astype(int), columns.astype(int))][coverage(mesh, size) > 0]
    mean = (covered if len(covered) else texels.reshape(-1, 3)).mean(axis=0, dtype=np.float64)
    return mean.astype(np.float32).reshape(1, 1, 3)


def make_tint_tables(tints: Tints) -> TintTables | None:
    """The tables; None where no object has a texture."""
    import mitsuba as mi

    if not any(tint is not None for tint in tints):
        return None
    white = np.ones((1, 1, 3), np.float32)
    images = [white if tint is None else tint for tint in tints]
    sizes = [image.shape[0] * image.shape[1] for image in images]
    flat = np.concatenate([image.reshape(-1, 3) for image in images])
    return TintTables(
        texels=[mi.Float(np.ascontiguousarray(flat[:, channel])) for channel in range(3)],
        first=mi.UInt32(np.cumsum([0, *sizes])[:-1].astype(np.uint32)),
        width=mi.UInt32(np.array([image.shape[1] for image in images], np.uint32)),
        height=mi.UInt32(np.array([image.shape[0] for image in images], np.uint32)),
    )


def look_up_tint(tables: TintTables, shape, uv, active) -> "mi.Color3f":
    """Bilinear between the centres of texels, clamped beyond the outermost ones, as in Mitsuba's bitmap."""
    import drjit as dr
    import mitsuba as mi

    first, width, height = (
        dr.gather(mi.UInt32, table, shape, active) for table in (tables.first, tables.width, tables.height)
    )
    place = (uv.x * mi.Float(width) - 0.5, (1 - uv.y) * mi.Float(height) - 0.5)
    low = [dr.floor(value) for value in place]
    shares = [value - floor for value, floor in zip(place, low)]
    total = mi.Color3f(0)
    for row_step in range(2):
        for column_step in range(2):
            column = dr.clip(mi.Int32(low[0]) + column_step, 0, mi.Int32(width) - 1)
            row = dr.clip(mi.Int32(low[1]) + row_step, 0, mi.Int32(height) - 1)
            index = first + mi.UInt32(row) * width + mi.UInt32(column)
            texel = mi.Color3f(*(dr.gather(mi.Float, channel, index, active) for channel in tables.texels))
            share_x = shares[0] if column_step else 1 - shares[0]
            share_y = shares[1] if row_step else 1 - shares[1]
            total += texel * (share_x * share_y)
    return total
