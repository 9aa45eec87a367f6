"""Images of foreign materials: decoded with care, and what they mean for a whole surface."""

import dataclasses
import functools

import numpy as np
from jaxtyping import Float, Float32, UInt8

from datagen.data.images import linear_from_srgb, srgb_from_linear
from datagen.data.meshes import Mesh, points_on
from datagen.scene.images import opened_image
from datagen.scene.materials import Color
from hyaline_import.foreign import ForeignImage, ForeignMaterial
from hyaline_import.remarks import Remarks

MAX_SIDE = 2048
"""Texels a side that are kept."""
POINTS = 4096
"""Points of a surface at which its image is looked up."""
INVISIBLE = 1 / 512
"""Alpha below which a blended surface is invisible, since it rounds to 0 in 8 bits."""
SOLID_BLEND = 0.9
"""Alpha from which on a blended surface counts as opaque."""
CUTOFF = 0.5
"""Opacity from which on a blended surface is drawn."""
PARTLY = (0.1, 0.9)
"""Opacity that is neither nothing nor all."""
MOSTLY = 0.5
"""Share of a surface from which on its image's opacity decides for all of it."""


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


def values_on(mesh: Mesh, values: Float[np.ndarray, "tex_h tex_w"]) -> Float[np.ndarray, " point"]:
    """An image's values at points that are spread evenly over the surface."""
    faces = mesh.faces[points_on(mesh, POINTS).face]
    weights = np.random.default_rng(0).dirichlet((1, 1, 1), POINTS)
    u, v = np.einsum("pk,pkc->cp", weights, mesh.uv[faces].astype(np.float64))
    height, width = values.shape
    column, row = (np.floor(place % 1 * size).astype(int) for place, size in ((u, width), (-v, height)))
    return values[np.minimum(row, height - 1), np.minimum(column, width - 1)].astype(np.float64)


@functools.lru_cache(maxsize=256)
def mean_color(image: ForeignImage) -> Color:
    """The mean linear colour, weighted by alpha."""
    pixels = decoded(image).astype(np.float64)
    weight = pixels[..., 3:] if pixels[..., 3].any() else np.ones_like(pixels[..., 3:])
    red, green, blue = np.clip((pixels[..., :3] * weight).sum(axis=(0, 1)) / weight.sum(), 0, 1).tolist()
    return red, green, blue


# Opacity


def veiled(
    material: ForeignMaterial, mesh: Mesh, remarks: Remarks, *, has_uv: bool, where: str
) -> ForeignMaterial | None:
    """The material with one alpha in place of an image of it; None where most of the surface is cut away.

    Many files draw panes with an image whose alpha is, say, 0.3 everywhere. Leaves are drawn whole, or left out.
    """
    if material.alpha_mode == "opaque" or (material.alpha_mode == "blend" and material.is_glass):
        return material
    opacity = _opacity(material)
    seen = values_on(mesh, opacity) if has_uv else opacity
    if material.alpha_mode == "blend":
        partly = np.mean((seen > PARTLY[0]) & (seen < PARTLY[1]))
        if opacity.size == 1 or partly >= MOSTLY:
            alpha = float(seen.mean())
            return dataclasses.replace(material, alpha=alpha, opacity=None) if alpha >= INVISIBLE else None
    cutoff = material.alpha_cutoff if material.alpha_mode == "mask" else CUTOFF
    left = float(np.mean(seen >= cutoff))
    if MOSTLY <= left < 1:
        remarks.approximate(where, f"is cut out by its opacity, which leaves {100 * left:.0f} % of it; drawn whole")
    return dataclasses.replace(material, alpha=1.0, alpha_mode="opaque", opacity=None) if left >= MOSTLY else None


def _opacity(material: ForeignMaterial) -> Float32[np.ndarray, "tex_h tex_w"]:
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
