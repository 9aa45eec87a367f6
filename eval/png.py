"""The bytes of PNG files from anywhere: whether each of them is what the program that wrote it meant.

Pillow 12 checks the CRC of no chunk that it can do without, draws pictures whose last chunk is missing, and ignores
what follows it. So a file is walked chunk by chunk before it is decoded (https://www.w3.org/TR/png-3/).
"""

import zlib
from collections.abc import Iterator

from datagen.errors import HyalineError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
FIRST, LAST, ANIMATION = b"IHDR", b"IEND", b"acTL"


def check_png(data: bytes, *, where: str) -> None:
    """Raises a HyalineError when a bit has flipped anywhere in a PNG file, or it is cut off, goes on behind its end,
    or holds more than one picture."""
    if not data.startswith(SIGNATURE):
        raise HyalineError(f"{where}: not a PNG (it begins with {data[:8]!r}); expected an 8-bit sRGB PNG")
    kinds = list(_chunk_kinds(data, where))
    if kinds[0] != FIRST:
        raise HyalineError(f"{where}: damaged (its first chunk is {kinds[0]!r}, not its header)")
    if ANIMATION in kinds:
        raise HyalineError(f"{where}: is an animation; expected one picture")


def _chunk_kinds(data: bytes, where: str) -> Iterator[bytes]:
    """The type of each chunk, up to the last one, with which the file has to end."""
    place, kind = len(SIGNATURE), b""
    while kind != LAST:
        length = int.from_bytes(data[place : place + 4])
        end = place + 12 + length
        if place + 12 > len(data) or end > len(data):
            raise HyalineError(f"{where}: damaged (cut off after {len(data)} bytes)")
        kind = data[place + 4 : place + 8]
        if zlib.crc32(data[place + 4 : end - 4]) != int.from_bytes(data[end - 4 : end]):
            raise HyalineError(f"{where}: damaged (the checksum of its chunk {kind!r} at byte {place} differs)")
        yield kind
        place = end
    if place != len(data):
        raise HyalineError(f"{where}: damaged (goes on for {len(data) - place} bytes behind its end)")
