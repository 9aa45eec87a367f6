"""Checks of PNG files from any program that decoding does not make."""

import io
import warnings

import numpy as np
from PIL import Image

from datagen.disk.errors import HyalineError

SRGB = (0.45455, 0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
"""As gAMA and cHRM chunks describe it: exponent; x and y of white, red, green and blue."""
ORIENTATION = 0x0112
"""EXIF's tag."""


def check_png(data: bytes, *, where: str) -> None:
    """Raises a HyalineError for a picture that can be decoded, but has a chunk with a wrong checksum, no end, further
    pictures, another colour space than sRGB, or an orientation."""
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
            picture.verify()
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # EXIF data that cannot be read names no orientation.
            turned, said = picture.getexif().get(ORIENTATION, 1), picture.info
    except Exception as error:  # Of many kinds, as in `decode_png`.
        raise HyalineError(f"{where}: damaged ({error})") from error
    if getattr(picture, "is_animated", False):
        raise HyalineError(f"{where}: is an animation; expected one picture")
    if "icc_profile" in said:
        profile = (said["icc_profile"] or b"").replace(b"\0", b"").lower()  # Version 4 has UTF-16.
        is_srgb = b"srgb" in profile and b"linear" not in profile
    else:
        found = said.get("gamma", SRGB[0]), *said.get("chromaticity", SRGB[1:])
        is_srgb = "srgb" in said or np.allclose(found, SRGB, rtol=0, atol=0.005)
    if not is_srgb:
        raise HyalineError(f"{where}: its ICC profile, gAMA or cHRM chunk is not sRGB's; convert it to 8-bit sRGB")
    if turned != 1:
        raise HyalineError(f"{where}: has the EXIF orientation {turned}; rotate or mirror its pixels instead")
