"""Files of pictures: PNG, EXR and NumPy, and the one way from linear radiance to 8-bit sRGB."""

import io
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt16
from PIL import Image

from datagen.data.config import Resolution
from datagen.disk.errors import HyalineError
from datagen.disk.storage import read_regular


def srgb_from_linear(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Display-referred values in [0, 1] of linear ones, clipped. Source: IEC 61966-2-1."""
    clipped = np.clip(linear, 0, 1)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * np.maximum(clipped, 1e-9) ** (1 / 2.4) - 0.055)


def linear_from_srgb(encoded: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """The inverse of `srgb_from_linear` on [0, 1]."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def to_8bit(encoded: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """Values in [0, 1] as 8 bits, rounded to nearest."""
    return np.rint(np.clip(encoded, 0, 1) * 255).astype(np.uint8)


MAX_PNG_SIDE = 16384
"""Pixels: twice the largest dataset; decoding takes 1 GB."""
MAX_PNG_BYTES = 1 << 30


def read_png(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """An 8-bit RGB picture from any PNG."""
    picture = decode_png(read_regular(path, at_most=MAX_PNG_BYTES), where=str(path))
    return np.asarray(picture.convert("RGB"))


def decode_png(data: bytes, *, where: str, size: Resolution | None = None) -> Image.Image:
    """The picture in the bytes of a PNG file, in the file's own mode.

    Args:
        size: the size that it must have; a picture of another size is not decoded.
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


def mask_pixels(picture: Image.Image) -> Bool[np.ndarray, "h w"]:
    """Pixels that a mask shows: opaque ones if some are transparent, otherwise those that are bright in any channel."""
    if picture.mode.startswith("I"):  # Grey of 16 bits, which Pillow would clip, not scale; some have values of 8.
        return (grey := np.asarray(picture)) > grey.max() // 2
    if picture.has_transparency_data and (alpha := np.asarray(picture.convert("RGBA"))[..., 3]).min() < 128:
        return alpha > 127
    brightest = np.asarray(picture.convert("RGB")).max(axis=-1)
    return brightest > (0 if brightest.max() == 1 else 127)  # Labels are 0 and 1.


def png_bytes(image: UInt8[np.ndarray, "h w *c"] | UInt16[np.ndarray, "h w"]) -> bytes:
    """The PNG file of a picture: grey, RGB or RGBA of 8 bits, or grey of 16; the same picture gives the same bytes."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()


EXR_START = b"v/1\x01\x02\x00\x00\x00"
"""The first bytes of an EXR of scan lines in one part."""

EXR_CHANNELS = ("R", "G", "B", "noise.R", "noise.G", "noise.B")

MAX_EXR_SIDE = 1 << 16
MAX_HALF = 65504
"""The largest half-precision number."""

EXR_BLOCK_ROWS = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""Rows that are compressed at once by each compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB."""


def encode_exr(radiance: Float32[np.ndarray, "h w 3"], noise: Float32[np.ndarray, "h w 3"]) -> bytes:
    """The EXR of a view: linear R, G, B and noise.R, noise.G, noise.B. The same values give the same bytes."""
    import OpenEXR

    halves = np.clip(np.concatenate([radiance, noise], axis=-1), -MAX_HALF, MAX_HALF).astype(np.float16)
    channels = {name: halves[..., place] for place, name in enumerate(EXR_CHANNELS)}
    return _exr_bytes(channels, OpenEXR.PIZ_COMPRESSION)


def encode_float_exr(channels: Mapping[str, Float32[np.ndarray, "h w"]]) -> bytes:
    """An EXR of 32-bit floats by channel name, losslessly compressed. The same values give the same bytes."""
    import OpenEXR

    return _exr_bytes(channels, OpenEXR.ZIP_COMPRESSION)


def _exr_bytes(channels: Mapping[str, np.ndarray], compression: object) -> bytes:
    import OpenEXR

    planes = {name: np.ascontiguousarray(values) for name, values in channels.items()}
    buffer = io.BytesIO()
    OpenEXR.File({"compression": compression, "type": OpenEXR.scanlineimage}, planes, num_threads=0).write(buffer)
    return buffer.getvalue()


def decode_exr(data: bytes, *, where: str = "EXR") -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]]:
    """Radiance and noise from the bytes of an EXR; the inverse of `encode_exr`."""
    channels = _exr_channels(data, where=where)
    if missing := sorted({*EXR_CHANNELS} - channels.keys()):
        raise HyalineError(f"{where}: has no channel {missing[0]}; render it again")
    values = [channels[name] for name in EXR_CHANNELS]
    return np.stack(values[:3], axis=-1), np.stack(values[3:], axis=-1)


def decode_radiance(data: bytes, *, where: str) -> Float32[np.ndarray, "h w 3"]:
    """The colours of any EXR of scan lines in one part, floats or halves."""
    channels = _exr_channels(data, where=where)
    names = "RGB" if "R" in channels else "YYY"
    if not {*names} <= channels.keys():
        raise HyalineError(f"{where}: has the channels {', '.join(channels)}; expected R, G and B")
    return np.stack([channels[name] for name in names], axis=-1)


def _exr_channels(data: bytes, *, where: str) -> dict[str, Float32[np.ndarray, "h w"]]:
    """The channels of an EXR of scan lines by name; on some files that are cut short, OpenEXR itself never ends."""
    import OpenEXR

    try:
        attributes, place = _exr_header(data)
        left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
        rows_per_block = EXR_BLOCK_ROWS[attributes["compression"][0]]
        width, height = right + 1 - left, bottom + 1 - top
        if not (0 < width <= MAX_EXR_SIDE and 0 < height <= MAX_EXR_SIDE):
            raise ValueError(f"it has {width} x {height} pixels")
        offsets = struct.unpack_from(f"<{-(-height // rows_per_block)}Q", data, place)
        for block, offset in enumerate(offsets):
            row, size = struct.unpack_from("<iI", data, min(offset, len(data)))
            if row != top + block * rows_per_block or offset + 8 + size > len(data):
                raise ValueError(f"block {block} is incomplete")
        channels = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0).channels()
        return {name: np.asarray(channel.pixels, np.float32) for name, channel in channels.items()}
    except (KeyError, IndexError, ValueError, RuntimeError, struct.error) as error:
        raise HyalineError(f"{where}: damaged, or no EXR of scan lines ({error}); render or save it again") from error


def _exr_header(data: bytes) -> tuple[dict[str, bytes], int]:
    """The attributes by name, and where they end."""
    if not data.startswith(EXR_START):
        raise ValueError("not an EXR")
    attributes: dict[str, bytes] = {}
    place = len(EXR_START)
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


def read_npy(data: bytes, *, where: str) -> Float32[np.ndarray, "h w"]:
    """A plane of finite numbers from the bytes of a .npy file; pickles are never loaded."""
    buffer = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(buffer)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, _, dtype = read_header[version](buffer)
        if len(shape) == 3 and shape[2] == 1:
            shape = shape[:2]
        # A header may promise more than a machine has.
        if len(shape) != 2 or dtype.kind != "f" or np.prod(shape) * dtype.itemsize != len(data) - buffer.tell():
            raise ValueError(f"shape {shape} of {dtype} in {len(data):,} bytes")
        values = np.load(io.BytesIO(data), allow_pickle=False).reshape(shape).astype(np.float32)
    except (ValueError, KeyError, TypeError, OSError, OverflowError) as error:
        raise HyalineError(f"{where}: not a .npy of height x width numbers ({error}); expected floats") from error
    if not np.isfinite(values).all():
        raise HyalineError(f"{where}: holds numbers that are not finite; expected metres, 0 where nothing is")
    return values
