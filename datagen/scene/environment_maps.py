"""Reading maps of the environment: equirectangular pictures of linear radiance, as OpenEXR or Radiance files."""

import numpy as np
from jaxtyping import Float, Float32, UInt8

from datagen.data.images import decode_radiance
from datagen.disk.errors import HyalineError
from datagen.scene.bilinear import bilinear

MAX_HEIGHT = 8192
MAX_BYTES = 1 << 30

RadianceMap = Float32[np.ndarray, "h w 3"]
"""Straight up in the first row; see `EnvironmentMap` for the columns."""


def read_map(data: bytes, *, where: str) -> RadianceMap:
    """The linear radiance in the bytes of an EXR or of a Radiance file.

    Raises:
        HyalineError: it is neither, is damaged, or holds what is no radiance.
    """
    if len(data) > MAX_BYTES:
        raise HyalineError(f"{where}: holds {len(data):,} bytes; expected at most {MAX_BYTES:,}")
    radiance = _read_hdr(data, where) if data.startswith(b"#?") else decode_radiance(data, where=where)
    _check_size(radiance.shape[1], radiance.shape[0], where)
    if not np.isfinite(radiance).all() or radiance.min() < 0:
        row, column, _ = np.argwhere(~(np.isfinite(radiance) & (radiance >= 0)))[0]
        raise HyalineError(
            f"{where}: pixel (column {column}, row {row}) is {radiance[row, column].tolist()}; expected finite "
            "radiance of at least 0"
        )
    return radiance


def look_up(
    radiance: RadianceMap, directions: Float[np.ndarray, "... 3"], rotation_deg: float
) -> Float[np.ndarray, "... 3"]:
    """Bilinear radiance from unit directions (world space, +z up) in a map that is turned by so many degrees."""
    azimuth = np.arctan2(directions[..., 1], directions[..., 0]) - np.radians(rotation_deg)
    across = 0.5 - azimuth / (2 * np.pi)
    down = np.arccos(np.clip(directions[..., 2], -1, 1)) / np.pi
    return bilinear(radiance, across, down, wraps=(True, False))


def _check_size(width: int, height: int, where: str) -> None:
    if not (2 <= height <= MAX_HEIGHT and 2 <= width <= 2 * MAX_HEIGHT):
        raise HyalineError(
            f"{where}: is {width} x {height} pixels; expected a map of at most {2 * MAX_HEIGHT} x {MAX_HEIGHT}"
        )


def _read_hdr(data: bytes, where: str) -> RadianceMap:
    """A Radiance picture of RGBE pixels, its scan lines from the top and from the left, as everybody writes them."""
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
    """Fills one line, compressed by runs or not, and returns where the next one begins."""
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
