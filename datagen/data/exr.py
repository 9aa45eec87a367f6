"""EXR files: linear radiance and its noise, half floats; and the radiance in those of others."""

import io
import struct
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32

from datagen.disk.errors import HyalineError

START = b"v/1\x01\x02\x00\x00\x00"
"""Of an EXR with scan lines and one part."""

PIZ, ROWS_PER_BLOCK = 4, 32
"""The compression in which files are written, and the rows that it compresses at once."""
CHANNELS = ("R", "G", "B", "noise.R", "noise.G", "noise.B")

MAX_WIDTH = 1 << 16

BLOCK_ROWS = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""Rows that are compressed at once, by the number of the compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A,
DWAA, DWAB."""


def encode_exr(radiance: Float32[np.ndarray, "h w 3"], noise: Float32[np.ndarray, "h w 3"]) -> bytes:
    """The EXR of a view: linear R, G, B and noise.R, noise.G, noise.B. The same values give the same bytes."""
    import OpenEXR

    halves = np.concatenate([radiance, noise], axis=-1).astype(np.float16)
    channels = {name: np.ascontiguousarray(halves[..., place]) for place, name in enumerate(CHANNELS)}
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    buffer = io.BytesIO()
    OpenEXR.File(header, channels, num_threads=0).write(buffer)
    return buffer.getvalue()


def encode_float_exr(channels: Mapping[str, Float32[np.ndarray, "h w"]]) -> bytes:
    """An EXR of whole floats, by channel's name, losslessly compressed. The same values give the same bytes."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    buffer = io.BytesIO()
    planes = {name: np.ascontiguousarray(values) for name, values in channels.items()}
    OpenEXR.File(header, planes, num_threads=0).write(buffer)
    return buffer.getvalue()


def decode_exr(data: bytes, *, where: str = "EXR") -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]]:
    """Radiance and noise from the bytes of an EXR; the inverse of `encode_exr`.

    Raises:
        HyalineError: not an EXR that this package has written, or a damaged one.
    """
    import OpenEXR

    # On some files that are cut short, OpenEXR never ends.
    check_exr(data, where=where)
    try:
        channels = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0).channels()
        values = [np.asarray(channels[name].pixels, np.float32) for name in CHANNELS]
    except (RuntimeError, ValueError, KeyError) as error:
        raise HyalineError(f"{where}: not an EXR with colours and noise ({error}); render it again") from error
    return np.stack(values[:3], axis=-1), np.stack(values[3:], axis=-1)


def decode_radiance(data: bytes, *, where: str) -> Float32[np.ndarray, "h w 3"]:
    """The colours of an EXR that anybody may have written: scan lines of one part, floats or halves.

    Raises:
        HyalineError: another kind of EXR, or a damaged one.
    """
    import OpenEXR

    expected = "expected an OpenEXR file of scan lines with channels R, G and B"
    try:
        attributes, place = header_of(data)
        left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
        rows_per_block = BLOCK_ROWS[attributes["compression"][0]]
    except (KeyError, IndexError, ValueError, struct.error) as error:
        raise HyalineError(f"{where}: cannot be read ({error}); {expected}") from error
    width, height = right + 1 - left, bottom + 1 - top
    if not (0 < width <= MAX_WIDTH and 0 < height <= MAX_WIDTH):
        raise HyalineError(f"{where}: is {width} x {height} pixels; expected 1 to {MAX_WIDTH}")
    # On some files that are cut short, OpenEXR never ends.
    if fault := missing_block(data, place, first_row=top, height=height, rows_per_block=rows_per_block):
        raise HyalineError(f"{where}: damaged, {fault}; {expected}")
    try:
        channels = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0).channels()
        names = "RGB" if "R" in channels else "YYY"
        planes = [np.asarray(channels[name].pixels, np.float32) for name in names]
    except (RuntimeError, ValueError, KeyError) as error:
        raise HyalineError(f"{where}: cannot be read ({error}); {expected}") from error
    return np.stack(planes, axis=-1)


def check_exr(data: bytes, *, where: str) -> None:
    """Refuses what is no EXR as this package writes them: half floats in scan lines, every block within the file.

    Raises:
        HyalineError: names the first thing that is wrong.
    """
    try:
        attributes, place = header_of(data)
        window = struct.unpack("<4i", attributes["dataWindow"])
        compression = attributes["compression"]
    except (KeyError, ValueError, struct.error) as error:
        raise HyalineError(f"{where}: damaged, the header of the EXR is incomplete; render it again") from error
    width, height = window[2] + 1 - window[0], window[3] + 1 - window[1]
    if compression != bytes([PIZ]) or not (0 < width <= MAX_WIDTH and 0 < height <= MAX_WIDTH):
        raise HyalineError(f"{where}: damaged, an EXR of {width} x {height} pixels; render it again")
    fault = missing_block(data, place, first_row=window[1], height=height, rows_per_block=ROWS_PER_BLOCK)
    if fault is not None:
        raise HyalineError(f"{where}: damaged, {fault}; render it again")


def missing_block(data: bytes, place: int, *, first_row: int, height: int, rows_per_block: int) -> str | None:
    """What is wrong with the blocks of scan lines whose table stands at `place`; None where all lie within the file."""
    count = -(-height // rows_per_block)
    if len(data) < place + 8 * count:
        return "the EXR ends before its pixels"
    for block, offset in enumerate(struct.unpack_from(f"<{count}Q", data, place)):
        if offset + 8 > len(data):
            return f"block {block} of the EXR is missing"
        row, size = struct.unpack_from("<iI", data, offset)
        if row != first_row + block * rows_per_block or offset + 8 + size > len(data):
            return f"block {block} of the EXR is incomplete"
    return None


def header_of(data: bytes) -> tuple[dict[str, bytes], int]:
    """The attributes by name, and where they end.

    Raises:
        ValueError: no EXR of scan lines and one part, or cut short.
    """
    if not data.startswith(START):
        raise ValueError("not an EXR")
    attributes: dict[str, bytes] = {}
    place = len(START)
    while data[place : place + 1] != b"\x00":
        # A name and a type, both ended by zeros, then the size and the value.
        name, _, rest = data[place : place + 64].partition(b"\x00")
        kind, zero, _ = rest.partition(b"\x00")
        place += len(name) + len(kind) + 2
        (size,) = struct.unpack_from("<I", data, place)
        if not zero or place + 4 + size > len(data):
            raise ValueError("cut short")
        attributes[name.decode("latin-1")] = data[place + 4 : place + 4 + size]
        place += 4 + size
    return attributes, place + 1
