"""The images of a scene: textures and environment maps, read and looked up."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, UInt8

from datagen.data.images import decode_radiance, linear_from_srgb
from datagen.disk.errors import HyalineError

if TYPE_CHECKING:
    from PIL import Image

MAX_PIXELS = 1 << 26
"""Largest number of pixels of a user's image."""
FORMATS = ["PNG", "JPEG", "WEBP", "BMP", "TGA", "GIF", "TIFF"]
"""Accepted formats, whatever a file's ending: Pillow would start other programs for some others."""


@contextmanager
def opened_image(data: bytes, *, where: str) -> Iterator["Image.Image"]:
    """Opens an untrusted image file while its pixels are read; Pillow's errors in the block become a HyalineError."""
    from PIL import Image, UnidentifiedImageError

    Image.init()
    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as image:
            if image.width * image.height > MAX_PIXELS:
                raise HyalineError(
                    f"{where}: is {image.width} x {image.height} pixels; expected at most {MAX_PIXELS:,} pixels"
                )
            yield _in_8_bits(image)
    except (HyalineError, MemoryError):
        raise
    except UnidentifiedImageError as error:  # Its text contains the buffer's address.
        raise HyalineError(f"{where}: not an image that can be read; expected one of {', '.join(FORMATS)}") from error
    # Pillow raises many kinds of exceptions on broken files (OSError, SyntaxError, ValueError, struct.error, ...).
    except Exception as error:
        raise HyalineError(f"{where}: not an image that can be read ({type(error).__name__}: {error})") from error


def _in_8_bits(image: "Image.Image") -> "Image.Image":
    """The image, scaled if it is grey of 16 bits, which Pillow would clip, as it would 32 bits."""
    from PIL import Image

    if image.mode == "F" or (image.mode == "I" and image.format == "TIFF"):
        raise ValueError("it has 32 bits per channel; expected 8 or 16")

    if not image.mode.startswith("I"):
        return image
    return Image.fromarray(np.rint(np.asarray(image) / np.float32(257)).astype(np.uint8))


def linear_pixels(data: bytes, *, where: str) -> Float32[np.ndarray, "tex_h tex_w 3"]:
    """Linear reflectance of an sRGB image file; alpha is ignored."""
    with opened_image(data, where=where) as image:
        encoded = np.asarray(image.convert("RGB"))
    return linear_from_srgb(encoded / 255.0).astype(np.float32)


def look_up(
    image: Float32[np.ndarray, "tex_h tex_w 3"], uv: Float[np.ndarray, "h w 2"], *, repeats: bool
) -> Float[np.ndarray, "h w 3"]:
    """Bilinear, as Mitsuba looks it up; v = 1 is the first row."""
    return bilinear(image, uv[..., 0], 1 - uv[..., 1], wraps=(repeats, repeats))


def bilinear(
    pixels: Float32[np.ndarray, "tex_h tex_w 3"],
    across: Float[np.ndarray, "*point"],
    down: Float[np.ndarray, "*point"],
    *,
    wraps: tuple[bool, bool],
) -> Float[np.ndarray, "*point 3"]:
    """Bilinear colours at points of a picture, as Mitsuba looks them up.

    Args:
        across: positions from the left side, in picture widths; the first column's centre is at 0.5 / width.
        down: positions from the upper side, in picture heights.
        wraps: whether the picture repeats across, and down; otherwise its border is extended.
    """
    height, width = pixels.shape[:2]
    (left, right), right_share = _neighbours(across, width, wraps=wraps[0])
    rows, low_share = _neighbours(down, height, wraps=wraps[1])
    upper, lower = (pixels[row, left] * (1 - right_share) + pixels[row, right] * right_share for row in rows)
    return upper * (1 - low_share) + lower * low_share


def _neighbours(place: np.ndarray, size: int, *, wraps: bool) -> tuple[list[np.ndarray], np.ndarray]:
    """The two pixels of a line on either side of each point, and the weight of the second."""
    pixel = place * size - 0.5
    first = np.floor(pixel).astype(np.int64)
    sides = [index % size if wraps else np.clip(index, 0, size - 1) for index in (first, first + 1)]
    return sides, (pixel - first)[..., None]


# Maps of the environment: equirectangular, linear radiance, as OpenEXR or Radiance files


MAX_MAP_HEIGHT = 8192
MAX_MAP_BYTES = 1 << 30

RadianceMap = Float32[np.ndarray, "h w 3"]
"""Radiance with straight up in the first row; see `EnvironmentMap` for the columns."""


def read_map(data: bytes, *, where: str) -> RadianceMap:
    """The linear radiance in an EXR or Radiance file; refuses damaged files and values that are not radiance."""
    if len(data) > MAX_MAP_BYTES:
        raise HyalineError(f"{where}: holds {len(data):,} bytes; expected at most {MAX_MAP_BYTES:,}")
    radiance = _read_hdr(data, where) if data.startswith(b"#?") else decode_radiance(data, where=where)
    _check_size(radiance.shape[1], radiance.shape[0], where)
    if not np.isfinite(radiance).all() or radiance.min() < 0:
        row, column, _ = np.argwhere(~(np.isfinite(radiance) & (radiance >= 0)))[0]
        raise HyalineError(
            f"{where}: pixel (column {column}, row {row}) is {radiance[row, column].tolist()}; expected finite "
            "radiance of at least 0"
        )
    return radiance


def _check_size(width: int, height: int, where: str) -> None:
    if not (2 <= height <= MAX_MAP_HEIGHT and 2 <= width <= 2 * MAX_MAP_HEIGHT):
        raise HyalineError(
            f"{where}: is {width} x {height} pixels; expected a map of at most {2 * MAX_MAP_HEIGHT} x {MAX_MAP_HEIGHT}"
        )


def _read_hdr(data: bytes, where: str) -> RadianceMap:
    """A Radiance picture of RGBE pixels in the usual order, from the top and from the left.

    Mitsuba 3.9's own reader writes beyond its memory when a file is damaged, and accepts files that are cut short.
    """
    header, blank, rest = data.partition(b"\n\n")
    size, end, _ = rest[:256].partition(b"\n")
    words = size.split()
    if not (blank and end and len(words) == 4 and words[0] == b"-Y" and words[2] == b"+X") or b"XYZE" in header:
        raise HyalineError(f"{where}: not a Radiance picture of RGBE pixels, rows from the top (-Y) and left (+X)")
    try:
        height, width = int(words[1]), int(words[3])
    except ValueError as error:
        raise HyalineError(f"{where}: not a Radiance picture ({error})") from error
    _check_size(width, height, where)
    place = len(header) + 2 + len(size) + 1
    pixels = np.zeros((height, width, 4), np.uint8)
    for row in range(height):
        try:
            place = _read_scanline(data, place, pixels[row])
        except (IndexError, ValueError) as error:
            raise HyalineError(f"{where}: damaged, row {row} of {height} is cut short or broken") from error
    # Source: Ward 1991, "Real Pixels": mantissas of 8 bits share an exponent; 0 is black.
    exponent = np.where(pixels[..., 3] > 0, np.exp2(pixels[..., 3].astype(np.float64) - 136), 0)
    return (pixels[..., :3] * exponent[..., None]).astype(np.float32)


def _read_scanline(data: bytes, place: int, line: UInt8[np.ndarray, "w 4"]) -> int:
    """Reads one line, run-length encoded or not, and returns where the next one begins."""
    width = len(line)
    if data[place : place + 4] != bytes([2, 2, width >> 8, width & 255]) or not 8 <= width < 32768:
        flat = np.frombuffer(data, np.uint8, 4 * width, place)
        line[:] = flat.reshape(width, 4)
        return place + 4 * width
    place += 4
    for channel in range(4):
        column = 0
        while column < width:
            count = data[place]
            if count > 128:
                count -= 128
                line[column : column + count, channel] = data[place + 1]
                place += 2
            else:
                line[column : column + count, channel] = np.frombuffer(data, np.uint8, count, place + 1)
                place += 1 + count
            if count == 0 or column + count > width:
                raise ValueError("a run that does not fit")
            column += count
    return place
