"""Images of foreign materials: decoded with care, and written as the PNG that a scene of ours holds."""

import numpy as np
from jaxtyping import Float32

from datagen.data.png import png_bytes
from datagen.data.tonemap import linear_from_srgb, srgb_from_linear, to_8bit
from datagen.scene.images import opened_image
from datagen.scene.importers.foreign import ForeignImage
from datagen.scene.values import Color

MAX_SIDE = 2048
"""Texels a side that are kept."""


def decoded(image: ForeignImage) -> Float32[np.ndarray, "tex_h tex_w 4"]:
    """Linear colour and alpha of an image of at most `MAX_SIDE` texels a side; a larger one is reduced.

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
    values = np.asarray(rgba).astype(np.float64) / 255
    values[..., :3] = linear_from_srgb(values[..., :3])
    return values.astype(np.float32)


def tinted_png(pixels: Float32[np.ndarray, "tex_h tex_w 4"], color: Color) -> bytes:
    """The sRGB PNG of an image times a colour, its alpha left out."""
    return png_bytes(to_8bit(srgb_from_linear(pixels[..., :3].astype(np.float64) * np.array(color))))


def mean_color(pixels: Float32[np.ndarray, "tex_h tex_w 4"]) -> Color:
    """The mean linear colour, weighted by alpha."""
    weight = pixels[..., 3:].astype(np.float64)
    total = float(weight.sum())
    mean = (pixels[..., :3] * weight).sum(axis=(0, 1)) / total if total > 0 else pixels[..., :3].mean(axis=(0, 1))
    red, green, blue = (min(max(float(value), 0.0), 1.0) for value in mean)
    return red, green, blue
