"""What metals mirror over their surface, where a texture says so: texels that the kernel looks up by uv."""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float32

from datagen.data.meshes import Mesh, is_there
from datagen.render.mitsuba_scene import linear_texels
from datagen.scene.description import Scene

if TYPE_CHECKING:
    import mitsuba as mi

Texels = Float32[np.ndarray, "tex_h tex_w 3"]
Tints = tuple[Texels | None, ...]
"""By object; None where one colour says all. Row 0 is on top, where v is 1."""


class TintTables(NamedTuple):
    """The texels of all objects; an object without a texture has one that is white."""

    texels: "list[mi.Float]"
    """By colour channel."""
    first: "mi.UInt32"
    """By object, its first texel."""
    width: "mi.UInt32"
    height: "mi.UInt32"


def tints_of(scene: Scene, *, own_uv: bool) -> Tints:
    """The textures of a scene's metals.

    Args:
        own_uv: light is followed on the objects' own meshes. Proxies have another uv, and get the mean colour.
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
    """The mean over the part of an atlas that a surface covers."""
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
    """Bilinear between the centres of texels, and the outermost ones beyond them, as Mitsuba's bitmap is."""
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
            column = _within(mi.Int32(low[0]) + column_step, width)
            row = _within(mi.Int32(low[1]) + row_step, height)
            index = first + row * width + column
            texel = mi.Color3f(*(dr.gather(mi.Float, channel, index, active) for channel in tables.texels))
            share_x = shares[0] if column_step else 1 - shares[0]
            share_y = shares[1] if row_step else 1 - shares[1]
            total += texel * (share_x * share_y)
    return total


def _within(index, size) -> "mi.UInt32":
    import drjit as dr
    import mitsuba as mi

    return mi.UInt32(dr.clip(index, 0, mi.Int32(size) - 1))
