"""PNG files: 8-bit pictures that anybody may have written, and our own."""

import io
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16
from PIL import Image

from datagen.data.resolution import Resolution
from datagen.disk.errors import HyalineError
from datagen.disk.records import read_regular

MAX_PNG_SIDE = 16384
"""Pixels: twice the largest dataset, whose decoding takes 1 GB."""
MAX_PNG_BYTES = 1 << 30


def read_png(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """An 8-bit RGB picture from any PNG.

    Raises:
        HyalineError: missing or not a picture.
    """
    return np.asarray(open_png(path).convert("RGB"))


def open_png(path: Path, *, size: Resolution | None = None) -> Image.Image:
    """The picture in a PNG file, decoded, in the file's own mode; see `decode_png`.

    Raises:
        HyalineError: missing, or no regular file.
    """
    return decode_png(read_regular(path, at_most=MAX_PNG_BYTES), where=str(path), size=size)


def decode_png(data: bytes, *, where: str, size: Resolution | None = None) -> Image.Image:
    """The picture in the bytes of a PNG file, in the file's own mode.

    Args:
        size: which it has to have; nothing of a picture of another size is decoded.

    Raises:
        HyalineError: not a PNG of at most 8 bits a channel, too large, or of another size.
    """
    if len(data) < 33 or data[:8] != b"\x89PNG\r\n\x1a\n" or data[12:16] != b"IHDR":
        raise HyalineError(f"{where}: not a PNG that can be read; expected an 8-bit sRGB PNG")
    width, height, depth = (int.from_bytes(data[at:end]) for at, end in ((16, 20), (20, 24), (24, 25)))
    if size is not None and (width, height) != (size.width, size.height):
        raise HyalineError(f"{where}: is {width} x {height} pixels; expected {size}, as the truth has")
    if not (0 < width <= MAX_PNG_SIDE and 0 < height <= MAX_PNG_SIDE):
        raise HyalineError(f"{where}: is {width} x {height} pixels; expected 1 to {MAX_PNG_SIDE} a side")
    if depth > 8:
        raise HyalineError(f"{where}: has {depth} bits a channel; expected 8-bit sRGB")
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
            picture.load()
            return picture
    # Pillow answers a broken file with many kinds of exception (OSError, SyntaxError, ValueError, struct.error, ...).
    except Exception as error:
        raise HyalineError(f"{where}: not a PNG that can be read ({error})") from error


def png_bytes(image: UInt8[np.ndarray, "h w *c"] | UInt16[np.ndarray, "h w"]) -> bytes:
    """The PNG file of a picture: grey, RGB or RGBA of 8 bits, or grey of 16; the same picture gives the same bytes."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()
