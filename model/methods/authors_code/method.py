"""How `authors-code` is made: what the dataset decides, the renderer, and the pixels."""

import dataclasses
from collections.abc import Sequence

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from model.batches.rays import PixelSource, RayBatch
from model.methods.authors_code.config import AuthorsConfig
from model.methods.authors_code.renderer import AuthorsRenderer, build_authors
from model.methods.paper.renderer import default_texture_size
from model.methods.protocol import Inputs
from model.methods.stored_pixels import load_stored, peel_as_stored


def complete(config: AuthorsConfig, inputs: Inputs) -> AuthorsConfig:
    side, num_objects = inputs.dataset.config.resolution.mean_side, len(inputs.dataset.objects)
    size = config.texture_size or default_texture_size(side, num_objects, "object")
    return dataclasses.replace(config, texture_size=size)


def build(config: AuthorsConfig, inputs: Inputs) -> AuthorsRenderer:
    return build_authors(config, inputs)


def load(
    config: AuthorsConfig,  # noqa: ARG001
    inputs: Inputs,
    split: Split,
    views: Sequence[int],
    *,
    with_images: bool,
    mapped: bool,
) -> PixelSource[RayBatch]:
    return load_stored(inputs, split, views, with_images=with_images, mapped=mapped)


def load_cameras(config: AuthorsConfig, inputs: Inputs, cameras: Cameras) -> PixelSource[RayBatch]:  # noqa: ARG001
    return peel_as_stored(inputs, cameras)
