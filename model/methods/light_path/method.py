"""How `light-path` is made: what the dataset decides, the renderer, and the pixels."""

from collections.abc import Sequence

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from model.methods.light_path.config import LightPathConfig
from model.methods.light_path.net import LightPathRenderer, build_light_path
from model.methods.light_path.pixels import (
    LightPathPixels,
    load_light_path_pixels,
    share_texels,
    trace_light_paths,
)
from model.methods.protocol import Inputs


def complete(config: LightPathConfig, inputs: Inputs) -> LightPathConfig:
    """The same with the objects' textures; paths are traced to see how texels are shared."""
    size = config.texture_size or inputs.dataset.config.resolution
    return config.sized(share_texels(inputs.dataset, inputs.geometry, size))


def build(config: LightPathConfig, inputs: Inputs) -> LightPathRenderer:
    return build_light_path(config, inputs.dataset)


def load(
    config: LightPathConfig,
    inputs: Inputs,
    split: Split,
    views: Sequence[int],
    *,
    with_images: bool,
    mapped: bool,  # noqa: ARG001
) -> LightPathPixels:
    return load_light_path_pixels(config, inputs.dataset, inputs.geometry, split, views, with_images)


def load_cameras(config: LightPathConfig, inputs: Inputs, cameras: Cameras) -> LightPathPixels:
    return trace_light_paths(config, inputs.dataset, inputs.geometry, cameras)
