"""Images that colour surfaces: read, looked up, and baked into another uv."""

import io

import numpy as np
from jaxtyping import Float, Float32

from datagen.data.meshes import Mesh
from datagen.data.png import png_bytes
from datagen.data.tonemap import linear_from_srgb, srgb_from_linear, to_8bit
from datagen.disk.errors import HyalineError
from datagen.scene.atlas import bake_corners
from datagen.scene.bilinear import bilinear

MIN_SIZE, MAX_SIZE = 128, 2048
"""Texels a side of an image that is baked anew."""


def linear_pixels(data: bytes, *, where: str) -> Float32[np.ndarray, "tex_h tex_w 3"]:
    """Linear reflectance of an image file, which is sRGB; alpha is left out.

    Raises:
        HyalineError: it is no image.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data)) as image:
            encoded = np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise HyalineError(f"{where}: not an image that can be read ({error})") from error
    return linear_from_srgb(encoded / 255.0).astype(np.float32)


def baked_image(image: Float32[np.ndarray, "tex_h tex_w 3"], before: Mesh, after: Mesh) -> bytes:
    """The PNG that colours a surface in its new uv as the image did in the old one; outside of [0, 1] that repeats.

    Args:
        after: the same faces in the same order, with another uv.
    """
    wanted = 2 ** np.ceil(np.log2(max(image.shape[:2])))
    size = int(np.clip(wanted, MIN_SIZE, MAX_SIZE))
    uv = bake_corners(after, before.uv[before.faces].astype(np.float64), size)
    repeats = bool(before.uv.min() < 0 or before.uv.max() > 1)
    return png_bytes(to_8bit(srgb_from_linear(look_up(image, uv, repeats=repeats))))


def look_up(
    image: Float32[np.ndarray, "tex_h tex_w 3"], uv: Float[np.ndarray, "h w 2"], *, repeats: bool
) -> Float[np.ndarray, "h w 3"]:
    """Bilinear, as Mitsuba looks it up; v = 1 is the first row."""
    return bilinear(image, uv[..., 0], 1 - uv[..., 1], wraps=(repeats, repeats))
