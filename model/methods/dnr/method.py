"""How `dnr` and `dnr-layers` are made: what the dataset decides, the renderer, and the pixels."""

import dataclasses
from collections.abc import Sequence

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.disk.errors import HyalineError
from model.batches.rays import PixelSource, RayBatch
from model.methods.dnr.config import LEAST_CROP, DnrConfig
from model.methods.dnr.renderer import DnrRenderer, build_dnr
from model.methods.paper.renderer import default_texture_size
from model.methods.protocol import Inputs
from model.methods.stored_pixels import load_stored, peel_as_stored


def complete(config: DnrConfig, inputs: Inputs) -> DnrConfig:
    """The same with sizes that the picture's gives.

    Textures are as wide as those of `paper`: half the picture's side for each object, so that the methods differ in
    what they do and not in their texels. Crops are squares of half the picture's shorter side (256 pixels of 512
    are common), but 128 pixels at least: a narrower one leaves the U-Net's innermost level nothing but its border,
    which a whole picture is not (measured on the glass table at 128 pixels: crops of 64 cost 3 dB on both splits).
    """
    resolution = inputs.dataset.config.resolution
    side = resolution.shorter
    crop = min(side, max(side // 2, LEAST_CROP)) if config.crop is None else config.crop
    if crop > side:
        raise HyalineError(f"crop: is {crop}; expected at most {side}, the shorter side of pictures of {resolution}")
    size = config.texture_size or default_texture_size(resolution.mean_side, len(inputs.dataset.objects), "object")
    return dataclasses.replace(config, texture_size=size, crop=crop)


def build(config: DnrConfig, inputs: Inputs) -> DnrRenderer:
    return build_dnr(config, inputs)


def load(
    config: DnrConfig,  # noqa: ARG001
    inputs: Inputs,
    split: Split,
    views: Sequence[int],
    *,
    with_images: bool,
    mapped: bool,
) -> PixelSource[RayBatch]:
    return load_stored(inputs, split, views, with_images=with_images, mapped=mapped, whole_views=True)


def load_cameras(config: DnrConfig, inputs: Inputs, cameras: Cameras) -> PixelSource[RayBatch]:  # noqa: ARG001
    return peel_as_stored(inputs, cameras, whole_views=True)
