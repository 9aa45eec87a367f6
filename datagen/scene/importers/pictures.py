"""Images of foreign materials: decoded with care, and written as the PNG that a scene of ours holds."""

import functools

import numpy as np
from jaxtyping import Float, Float32, UInt8

from datagen.data.meshes import Mesh, face_areas
from datagen.data.png import png_bytes
from datagen.data.tonemap import linear_from_srgb, srgb_from_linear, to_8bit
from datagen.scene.cutouts import corner_uv_of
from datagen.scene.images import opened_image
from datagen.scene.importers.foreign import ForeignImage
from datagen.scene.values import Color

MAX_SIDE = 2048
"""Texels a side that are kept."""
INSIDE = (np.ones((3, 3)) + 3 * np.eye(3)) / 6
"""Barycentric coordinates of the points of a face where an image is looked up."""


def decoded(image: ForeignImage) -> Float32[np.ndarray, "tex_h tex_w 4"]:
    """Linear colour and alpha of an image of at most `MAX_SIDE` texels a side; a larger one is reduced.

    Raises:
        HyalineError: it is no image that can be read.
    """
    values = stored(image) / np.float64(255)
    values[..., :3] = linear_from_srgb(values[..., :3])
    return values.astype(np.float32)


@functools.lru_cache(maxsize=4)
def stored(image: ForeignImage) -> UInt8[np.ndarray, "tex_h tex_w 4"]:
    """RGBA as the file holds it, reduced as in `decoded`; read-only.

    Raises:
        HyalineError: it is no image that can be read.
    """
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
    """An image's values at three points of each face, and the area that each of them stands for."""
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
