"""Images of foreign materials: decoded with care, written as PNG, and what their opacity cuts away."""

import dataclasses
import functools

import numpy as np
from jaxtyping import Float, Float32, UInt8

from datagen.data.images import linear_from_srgb, png_bytes, srgb_from_linear, to_8bit
from datagen.data.meshes import Mesh, face_areas
from datagen.scene.images import opened_image
from datagen.scene.materials import Color
from hyaline_import.cutouts import Cut, Opacity, corner_uv_of
from hyaline_import.foreign import ForeignImage, ForeignMaterial
from hyaline_import.remarks import Remarks

MAX_SIDE = 2048
"""Texels a side that are kept."""
INSIDE = (np.ones((3, 3)) + 3 * np.eye(3)) / 6
"""Barycentric coordinates of the points of a face where an image is looked up."""
INVISIBLE = 1 / 512
"""Alpha below which a blended surface is invisible, since it rounds to 0 in 8 bits."""
SOLID_BLEND = 0.9
"""Alpha from which on a blended surface counts as opaque."""
BLEND_CUTOFF = 0.5
"""Opacity from which on a blended surface is drawn."""
PARTLY = (0.1, 0.9)
"""Opacity that is neither nothing nor all."""
MOSTLY = 0.5
"""Share of a surface from which on it is a pane if its image is partly opaque there."""


def decoded(image: ForeignImage) -> Float32[np.ndarray, "tex_h tex_w 4"]:
    """Linear colour and alpha of an image of at most `MAX_SIDE` texels a side; a larger one is reduced."""
    values = stored(image) / np.float64(255)
    values[..., :3] = linear_from_srgb(values[..., :3])
    return values.astype(np.float32)


@functools.lru_cache(maxsize=4)
def stored(image: ForeignImage) -> UInt8[np.ndarray, "tex_h tex_w 4"]:
    """RGBA as the file holds it, reduced as in `decoded`; read-only."""
    from PIL import Image

    with opened_image(image.data, where=f"image of {image.name}") as picture:
        if max(picture.size) > MAX_SIDE:
            picture.draft("RGB", (MAX_SIDE, MAX_SIDE))
        rgba = picture.convert("RGBA")
    if max(rgba.size) > MAX_SIDE:
        rgba.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.BOX)
    return np.asarray(rgba)


def values_on(
    mesh: Mesh, values: Float[np.ndarray, "tex_h tex_w"]
) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, " point"]]:
    """An image's values at three points of each face, and the area that each represents."""
    points = np.einsum("pk,fkc->fpc", INSIDE, corner_uv_of(mesh).astype(np.float64)).reshape(-1, 2)
    height, width = values.shape
    column, row = (
        np.floor(place % 1 * size).astype(int) for place, size in ((points[:, 0], width), (-points[:, 1], height))
    )
    seen = values[np.minimum(row, height - 1), np.minimum(column, width - 1)].astype(np.float64)
    return seen, np.repeat(face_areas(mesh), len(INSIDE)) + np.finfo(np.float32).tiny  # So that some of them count.


def linear_png(pixels: Float[np.ndarray, "tex_h tex_w 3"]) -> bytes:
    """The sRGB PNG of linear colours."""
    return png_bytes(to_8bit(srgb_from_linear(pixels)))


def mean_color(pixels: Float32[np.ndarray, "tex_h tex_w 4"]) -> Color:
    """The mean linear colour, weighted by alpha."""
    weight = pixels[..., 3:].astype(np.float64)
    total = float(weight.sum())
    mean = (pixels[..., :3] * weight).sum(axis=(0, 1)) / total if total > 0 else pixels[..., :3].mean(axis=(0, 1))
    red, green, blue = (min(max(float(value), 0.0), 1.0) for value in mean)
    return red, green, blue


# Opacity


def veiled(material: ForeignMaterial, mesh: Mesh, *, has_uv: bool) -> ForeignMaterial:
    """The material as one of a single alpha where its image lets a part of the light through nearly everywhere.

    Many files draw panes in this way: an image of their colour whose alpha is, say, 0.3 everywhere.
    """
    if material.alpha_mode != "blend" or not has_uv or (material.image is None and material.opacity is None):
        return material
    seen, areas = values_on(mesh, _opacity(material))
    partly = areas[(seen > PARTLY[0]) & (seen < PARTLY[1])].sum() / areas.sum()
    if partly < MOSTLY:
        return material
    return dataclasses.replace(material, alpha=float(seen @ areas / areas.sum()), opacity=None)


def cut_of(
    material: ForeignMaterial, mesh: Mesh, remarks: Remarks, *, has_uv: bool, is_solid: bool, where: str
) -> Cut | None:
    """How a surface is to be cut; None where nothing is cut away."""
    is_pane = material.alpha_mode == "blend" and INVISIBLE <= material.alpha < SOLID_BLEND
    if material.alpha_mode == "opaque" or is_pane or (is_solid and material.alpha_mode == "blend"):
        return None
    opacity = _opacity(material)
    cutoff = min(material.alpha_cutoff, 2.0) if material.alpha_mode == "mask" else BLEND_CUTOFF
    if opacity.min() >= cutoff:
        return None
    if is_solid:
        remarks.approximate(where, "is cut out by its opacity, which would open a solid; drawn whole")
        return None
    if not has_uv and opacity.size > 1:
        remarks.approximate(where, "is cut out by an image, and has no uv; drawn whole")
        return None
    remarks.note(where, f"is cut out where its opacity is below {cutoff:.2g}")
    return Cut(opacity=opacity, cutoff=cutoff, corner_uv=corner_uv_of(mesh))


def _opacity(material: ForeignMaterial) -> Opacity:
    """Per texel, the factor included; one texel without an image."""
    if material.opacity is not None:
        pixels = decoded(material.opacity)
        has_alpha = pixels[..., 3].min() < 1
        values = pixels[..., 3] if has_alpha else srgb_from_linear(pixels[..., :3].astype(np.float64)).mean(axis=-1)
    elif material.image is not None:
        values = decoded(material.image)[..., 3]
    else:
        values = np.ones((1, 1))
    return (values * material.alpha).astype(np.float32)
