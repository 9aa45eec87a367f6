"""Integrity checks of PNG files from any program.

Pillow 12 does not check the CRC of optional chunks, accepts files without their last chunk, and ignores trailing data,
colour spaces and orientation. So a file is checked chunk by chunk before it is decoded (https://www.w3.org/TR/png-3/).
"""

import struct
import zlib
from collections.abc import Iterator, Mapping

from datagen.disk.errors import HyalineError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
FIRST, PIXELS, LAST, ANIMATION = b"IHDR", b"IDAT", b"IEND", b"acTL"
CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Channels by colour type."""

MOST_BYTES = 1 << 28

SRGB_GAMMA, SRGB_CICP = 45455, bytes((1, 13, 0, 1))
SRGB_PRIMARIES = (31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)
"""As cHRM has them: white, red, green, blue."""
MOST_PROFILE_BYTES = 1 << 20
ORIENTATION = 0x0112
"""EXIF's tag."""


def check_png(data: bytes, *, where: str) -> None:
    """Raises a HyalineError for a PNG file with a flipped bit anywhere, missing or trailing data, more than one
    picture, another colour space than sRGB, or an orientation."""
    if not data.startswith(SIGNATURE):
        raise HyalineError(f"{where}: not a PNG (it begins with {data[:8]!r}); expected an 8-bit sRGB PNG")
    chunks = list(_chunks(data, where))
    kinds = [kind for kind, _ in chunks]
    if kinds[0] != FIRST:
        raise HyalineError(f"{where}: damaged (its first chunk is {kinds[0]!r}, not its header)")
    if ANIMATION in kinds:
        raise HyalineError(f"{where}: is an animation; expected one picture")
    _check_shown_as_is(dict(chunks), where)
    _check_pixels(chunks[0][1], b"".join(body for kind, body in chunks if kind == PIXELS), where)


def _check_shown_as_is(said: Mapping[bytes, bytes], where: str) -> None:
    """Raises a HyalineError for colours other than sRGB or an orientation; of several colour chunks, the first one here
    takes precedence (section 4.3 of the standard), and without any, pixels are sRGB."""
    problem = None
    if b"cICP" in said:
        problem = None if said[b"cICP"] == SRGB_CICP else f"its cICP chunk is {list(said[b'cICP'])}"
    elif b"iCCP" in said:
        problem = None if _is_srgb_profile(said[b"iCCP"]) else "its iCCP chunk holds another ICC profile"
    elif b"sRGB" not in said:
        gamma = int.from_bytes(said.get(b"gAMA", SRGB_GAMMA.to_bytes(4)))
        if abs(gamma - SRGB_GAMMA) > 5:
            problem = f"its gAMA chunk is {gamma}, not {SRGB_GAMMA}"
        primaries = said.get(b"cHRM", b"")
        found = struct.unpack(">8I", primaries) if len(primaries) == 32 else SRGB_PRIMARIES
        if any(abs(one - other) > 500 for one, other in zip(found, SRGB_PRIMARIES, strict=True)):
            problem = "its cHRM chunk names other primaries"
    if problem is not None:
        raise HyalineError(f"{where}: its colours are not sRGB ({problem}); convert it to 8-bit sRGB")
    if (turned := _orientation(said.get(b"eXIf", b""))) != 1:
        raise HyalineError(f"{where}: has the EXIF orientation {turned}; rotate or mirror its pixels instead")


def _is_srgb_profile(body: bytes) -> bool:
    """True for a profile whose name says sRGB, as editors embed it."""
    try:
        profile = zlib.decompressobj().decompress(body.partition(b"\0")[2][1:], MOST_PROFILE_BYTES)
    except zlib.error:
        return False
    text = profile.replace(b"\0", b"").lower()  # Version 4 has UTF-16.
    return b"srgb" in text and b"linear" not in text


def _orientation(exif: bytes) -> int:
    """A picture's EXIF orientation, 1 to 8; 1 (upright) by default."""
    order = {b"II": "<", b"MM": ">"}.get(exif[:2], "<")
    try:
        (start,) = struct.unpack_from(f"{order}I", exif, 4)
        (count,) = struct.unpack_from(f"{order}H", exif, start)
        entries = [struct.unpack_from(f"{order}HHIH", exif, start + 2 + 12 * entry) for entry in range(count)]
    except struct.error:
        return 1
    return next((value for tag, _, _, value in entries if tag == ORIENTATION), 1)


def _check_pixels(header: bytes, body: bytes, where: str) -> None:
    """Raises a HyalineError unless the number of pixels matches the header; Pillow 12 draws missing ones black."""
    if len(header) != 13:
        raise HyalineError(f"{where}: damaged (its header has {len(header)} bytes, not 13)")
    width, height, depth, color, _, _, interlace = struct.unpack(">IIBBBBB", header)
    row = 1 + -(-width * depth * CHANNELS.get(color, 0) // 8)
    if interlace or row * height > MOST_BYTES:
        return  # Interlaced: Pillow counts the rows of its seven small pictures. Or too large, and refused later.
    try:
        found = len(zlib.decompressobj().decompress(body, row * height + 1))
    except zlib.error as error:
        raise HyalineError(f"{where}: damaged (its pixels cannot be unpacked: {error})") from error
    if found != row * height:
        what = "fewer" if found < row * height else "more"
        raise HyalineError(f"{where}: damaged (it has {what} pixels than the {width} x {height} of its header)")


def _chunks(data: bytes, where: str) -> Iterator[tuple[bytes, bytes]]:
    """Type and content of each chunk; the file must end with the last one."""
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
        raise HyalineError(f"{where}: damaged (has {len(data) - place} bytes after its end)")
