"""Pictures and masks of other projects, as the files of a dataset's view."""

import io
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image, ImageCms

from datagen.data.config import Resolution
from datagen.data.images import mask_pixels, png_bytes
from datagen.disk.errors import HyalineError
from hyaline_import.datasets.choices import DatasetImportChoices
from hyaline_import.datasets.layouts import ForeignView, header

BACKGROUND = {"white": 255.0, "black": 0.0}
EIGHT_BITS = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr")
PROFILED = {"1": "L", "L": "L", "LA": "L", "CMYK": "CMYK"}
"""What a profile of grey or CMYK converts, by the mode of its picture."""


def view_files(
    view: ForeignView, size: Resolution, choices: DatasetImportChoices, *, has_mask: bool
) -> dict[str, bytes]:
    """The files of a view, by ending."""
    picture = on_background(opened(view.picture, (size.width, size.height)), view.picture, choices.background)
    files = {".png": png_bytes(picture)}
    if has_mask:
        files[".mask.png"] = png_bytes(np.where(mask_of(view, size), 255, 0).astype(np.uint8))
    return files


def on_background(
    picture: Image.Image, path: Path, background: Literal["white", "black"]
) -> UInt8[np.ndarray, "h w 3"]:
    """An 8-bit picture over its background, in sRGB whatever its profile; mixed in sRGB as NeRF's tools do it."""
    if picture.mode not in EIGHT_BITS:
        raise HyalineError(f"{path}: has pixels of kind {picture.mode}; expected 8 bits a channel, sRGB")
    rgba = np.asarray(_in_srgb(picture, path))
    alpha = rgba[..., 3:].astype(np.float64) / 255
    return np.rint(rgba[..., :3] * alpha + BACKGROUND[background] * (1 - alpha)).astype(np.uint8)


def _in_srgb(picture: Image.Image, path: Path) -> Image.Image:
    """RGBA in sRGB; a picture may have another profile, such as the Display P3 of phones."""
    rgba = picture.convert("RGBA")
    if not (icc := picture.info.get("icc_profile")):
        return rgba
    mode = "RGB" if icc[16:20] == b"RGB " else PROFILED.get(picture.mode, "RGB")  # The pixels that a profile is for.
    pixels = rgba.convert("RGB") if mode == "RGB" else picture.convert(mode)
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(icc))
        converted = ImageCms.profileToProfile(pixels, profile, ImageCms.createProfile("sRGB"), outputMode="RGB")
    except (OSError, ImageCms.PyCMSError) as error:
        raise HyalineError(f"{path}: has a colour profile that cannot be used ({error}); convert it to sRGB") from None
    assert converted is not None, "None is for pictures that are changed in place"
    converted.putalpha(rgba.getchannel("A"))
    return converted


def mask_of(view: ForeignView, size: Resolution) -> Bool[np.ndarray, "h w"]:
    """Pixels that a view's mask shows."""
    assert view.mask is not None
    return mask_pixels(opened(view.mask, (size.width, size.height)))


def opened(path: Path, size: tuple[int, int] | None = None) -> Image.Image:
    """The picture of a file; nothing is decoded of one that has not the width and height it should have."""
    with header(path) as picture:
        if size is not None and picture.size != size:
            raise HyalineError(f"{path}: is {picture.width} x {picture.height} pixels; expected {size[0]} x {size[1]}")
        picture.load()
        return picture
