"""The bytes of PNG files from anywhere: whether each of them is what the program that wrote it meant.

Pillow 12 checks the CRC of no chunk that it can do without, draws pictures whose last chunk is missing, and ignores
what follows it. So a file is walked chunk by chunk before it is decoded (https://www.w3.org/TR/png-3/).
"""

import struct
import zlib
from collections.abc import Iterator

from datagen.disk.errors import HyalineError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
FIRST, PIXELS, LAST, ANIMATION = b"IHDR", b"IDAT", b"IEND", b"acTL"
CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""By colour type."""

MOST_BYTES = 1 << 28


def check_png(data: bytes, *, where: str) -> None:
    """Raises a HyalineError when a bit has flipped anywhere in a PNG file, or it is cut off, goes on behind its end,
    or holds more than one picture."""
    if not data.startswith(SIGNATURE):
        raise HyalineError(f"{where}: not a PNG (it begins with {data[:8]!r}); expected an 8-bit sRGB PNG")
    chunks = list(_chunks(data, where))
    kinds = [kind for kind, _ in chunks]
    if kinds[0] != FIRST:
        raise HyalineError(f"{where}: damaged (its first chunk is {kinds[0]!r}, not its header)")
    if ANIMATION in kinds:
        raise HyalineError(f"{where}: is an animation; expected one picture")
    _check_pixels(chunks[0][1], b"".join(body for kind, body in chunks if kind == PIXELS), where)


def _check_pixels(header: bytes, body: bytes, where: str) -> None:
    """Raises a HyalineError where there are not just as many pixels as promised: Pillow 12 draws missing ones black."""
    if len(header) != 13:
        raise HyalineError(f"{where}: damaged (its header has {len(header)} bytes, not 13)")
    width, height, depth, color, _, _, interlace = struct.unpack(">IIBBBBB", header)
    row = 1 + -(-width * depth * CHANNELS.get(color, 0) // 8)
    if interlace or row * height > MOST_BYTES:
        return  # Seven small pictures, whose rows Pillow counts; or one that is refused for its size.
    try:
        found = len(zlib.decompressobj().decompress(body, row * height + 1))
    except zlib.error as error:
        raise HyalineError(f"{where}: damaged (its pixels cannot be unpacked: {error})") from error
    if found != row * height:
        what = "fewer" if found < row * height else "more"
        raise HyalineError(f"{where}: damaged (it has {what} pixels than the {width} x {height} of its header)")


def _chunks(data: bytes, where: str) -> Iterator[tuple[bytes, bytes]]:
    """Type and content of each chunk, up to the last one, with which the file has to end."""
    place, kind = len(SIGNATURE), b""
    while kind != LAST:
        length = int.from_bytes(data[place : place + 4])
        end = place + 12 + length
        if place + 12 > len(data) or end > len(data):
            raise HyalineError(f"{where}: damaged (cut off after {len(data)} bytes)")
        kind = data[place + 4 : place + 8]
        if zlib.crc32(data[place + 4 : end - 4]) != int.from_bytes(data[end - 4 : end]):
            raise HyalineError(f"{where}: damaged (the checksum of its chunk {kind!r} at byte {place} differs)")
        yield kind, data[place + 8 : end - 4]
        place = end
    if place != len(data):
        raise HyalineError(f"{where}: damaged (goes on for {len(data) - place} bytes behind its end)")
