"""Images that colour surfaces: read, looked up, and baked into another uv."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32

from datagen.data.images import linear_from_srgb, png_bytes, srgb_from_linear, to_8bit
from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.scene.atlas import bake_corners
from datagen.scene.bilinear import bilinear

if TYPE_CHECKING:
    from PIL import Image

MIN_SIZE, MAX_SIZE = 128, 2048
"""Texels a side of an image that is baked anew."""
MAX_PIXELS = 1 << 26
"""Of an image that somebody brings."""
FORMATS = ["PNG", "JPEG", "WEBP", "BMP", "TGA", "GIF"]
"""Of images that are opened, whatever their names end in: Pillow would start other programs for some others."""


@contextmanager
def opened_image(data: bytes, *, where: str) -> Iterator["Image.Image"]:
    """An image file that anybody may have written, while its pixels are read.

    Raises:
        HyalineError: it is no image, or too large a one; it breaks off, in which case the block has failed.
    """
    from PIL import Image, UnidentifiedImageError

    Image.init()
    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as image:
            if image.width * image.height > MAX_PIXELS:
                raise HyalineError(
                    f"{where}: is {image.width} x {image.height} pixels; expected at most {MAX_PIXELS:,} pixels"
                )
            yield image
    except (HyalineError, MemoryError):
        raise
    except UnidentifiedImageError as error:  # Its text has the address of the buffer.
        raise HyalineError(f"{where}: not an image that can be read; expected one of {', '.join(FORMATS)}") from error
    # Pillow answers a broken file with many kinds of exception (OSError, SyntaxError, ValueError, struct.error, ...).
    except Exception as error:
        raise HyalineError(f"{where}: not an image that can be read ({type(error).__name__}: {error})") from error


def linear_pixels(data: bytes, *, where: str) -> Float32[np.ndarray, "tex_h tex_w 3"]:
    """Linear reflectance of an image file, which is sRGB; alpha is left out.

    Raises:
        HyalineError: it is no image.
    """
    with opened_image(data, where=where) as image:
        encoded = np.asarray(image.convert("RGB"))
    return linear_from_srgb(encoded / 255.0).astype(np.float32)


def baked_image(image: Float32[np.ndarray, "tex_h tex_w 3"], before: Mesh, after: Mesh) -> bytes:
    """The PNG that colours a surface in its new uv as the image did in the old one; outside of [0, 1] that repeats.

    Args:
        after: the same faces in the same order, with another uv.
    """
    a, b, c = np.moveaxis(before.uv[before.faces].astype(np.float64), 1, 0)
    # Texels that the surface shows: more than the image has, where it repeats.
    shown = 0.5 * np.abs(np.linalg.det(np.stack([b - a, c - a], axis=-1))).sum() * image.shape[0] * image.shape[1]
    wanted = 2 ** np.ceil(np.log2(max(*image.shape[:2], shown**0.5)))
    size = int(np.clip(wanted, MIN_SIZE, MAX_SIZE))
    uv = bake_corners(after, before.uv[before.faces].astype(np.float64), size)
    repeats = bool(before.uv.min() < 0 or before.uv.max() > 1)
    return png_bytes(to_8bit(srgb_from_linear(look_up(image, uv, repeats=repeats))))


def look_up(
    image: Float32[np.ndarray, "tex_h tex_w 3"], uv: Float[np.ndarray, "h w 2"], *, repeats: bool
) -> Float[np.ndarray, "h w 3"]:
    """Bilinear, as Mitsuba looks it up; v = 1 is the first row."""
    return bilinear(image, uv[..., 0], 1 - uv[..., 1], wraps=(repeats, repeats))
