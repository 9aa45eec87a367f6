"""The bytes of PNG files from anywhere: whether each of them is what the program that wrote it meant.

Pillow 12 checks the CRC of no chunk that it can do without, draws pictures whose last chunk is missing, and ignores
what follows it, and what a file says of its colours and of how it is to be turned. So a file is walked chunk by chunk
before it is decoded (https://www.w3.org/TR/png-3/).
"""

import struct
import zlib
from collections.abc import Iterator, Mapping

from datagen.disk.errors import HyalineError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
FIRST, PIXELS, LAST, ANIMATION = b"IHDR", b"IDAT", b"IEND", b"acTL"
CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""By colour type."""

MOST_BYTES = 1 << 28

SRGB_GAMMA, SRGB_CICP = 45455, bytes((1, 13, 0, 1))
SRGB_PRIMARIES = (31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)
"""As cHRM has them: white, red, green, blue."""
MOST_PROFILE_BYTES = 1 << 20
ORIENTATION = 0x0112
"""EXIF's tag."""


def check_png(data: bytes, *, where: str) -> None:
    """Raises a HyalineError when a bit has flipped anywhere in a PNG file, or it is cut off, goes on behind its end,
    holds more than one picture, or says that its pixels are not sRGB or are to be turned."""
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
    """Refuses a file whose pixels are not to be shown as they are; of several chunks on colour, the first here counts
    (section 4.3 of the standard), and without any they are sRGB."""
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
        raise HyalineError(f"{where}: its colours are not sRGB ({problem}); convert them to 8-bit sRGB, and write that")
    if (turned := _orientation(said.get(b"eXIf", b""))) != 1:
        raise HyalineError(
            f"{where}: is to be shown turned or mirrored (EXIF orientation {turned}); write its pixels as they are seen"
        )


def _is_srgb_profile(body: bytes) -> bool:
    """True of a profile that names itself sRGB, as editors embed it."""
    try:
        profile = zlib.decompressobj().decompress(body.partition(b"\0")[2][1:], MOST_PROFILE_BYTES)
    except zlib.error:
        return False
    text = profile.replace(b"\0", b"").lower()  # Version 4 has UTF-16.
    return b"srgb" in text and b"linear" not in text


def _orientation(exif: bytes) -> int:
    """How EXIF says that a picture is turned, 1 to 8; 1, not at all, where it does not say."""
    order = {b"II": "<", b"MM": ">"}.get(exif[:2], "<")
    try:
        (start,) = struct.unpack_from(f"{order}I", exif, 4)
        (count,) = struct.unpack_from(f"{order}H", exif, start)
        entries = [struct.unpack_from(f"{order}HHIH", exif, start + 2 + 12 * entry) for entry in range(count)]
    except struct.error:
        return 1
    return next((value for tag, _, _, value in entries if tag == ORIENTATION), 1)


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
