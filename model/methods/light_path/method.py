"""How `light-path` is made: what the dataset decides, the renderer, and the pixels."""

import dataclasses
import math
from collections.abc import Sequence

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.dataset import check_has_meshes
from datagen.disk.errors import HyalineError
from datagen.scene.description import EnvironmentMap, Scene, image_bytes
from datagen.scene.folder import open_scene
from datagen.scene.images import read_map
from model.methods.light_path.config import MAX_SKY_HEIGHT, SKY_HEIGHT, LightPathConfig
from model.methods.light_path.net import LightPathRenderer
from model.methods.light_path.pixels import (
    LightPathPixels,
    load_light_path_pixels,
    share_texels,
    trace_light_paths,
)
from model.methods.protocol import Inputs


def complete(config: LightPathConfig, inputs: Inputs) -> LightPathConfig:
    """The same with the objects' texture sizes, which depend on traced paths."""
    check_has_meshes(inputs.dataset)
    size = config.texture_size or inputs.dataset.config.resolution.mean_side
    if config.environment_size == SKY_HEIGHT:
        scene = open_scene(inputs.dataset)
        config = dataclasses.replace(config, environment_size=sky_height(scene))
    return config.sized(share_texels(inputs.dataset, inputs.geometry, size))


def sky_height(scene: Scene) -> int:
    """Rows of the learned sky's finest map: as fine as the environment map, or the edges of cards, that it shows."""
    if isinstance(scene.environment, EnvironmentMap):
        height = len(read_map(image_bytes(scene, scene.environment), where=scene.environment.path))
    else:
        height = max((math.ceil(180 / card.softness_deg) for card in scene.environment.cards), default=0)
    return max(SKY_HEIGHT, min(MAX_SKY_HEIGHT, 1 << max(height.bit_length() - 1, 0)))


def build(config: LightPathConfig, inputs: Inputs) -> LightPathRenderer:
    sizes, objects = config.texture_sizes, inputs.dataset.objects
    if len(sizes) != len(objects):
        raise HyalineError(f"texture_sizes: are {len(sizes)}; expected one for each of {len(objects)} objects")
    return LightPathRenderer(config)


def load(
    config: LightPathConfig,
    inputs: Inputs,
    split: Split,
    views: Sequence[int],
    *,
    with_images: bool,
) -> LightPathPixels:
    return load_light_path_pixels(config, inputs.dataset, inputs.geometry, split, views, with_images)


def load_cameras(config: LightPathConfig, inputs: Inputs, cameras: Cameras) -> LightPathPixels:
    return trace_light_paths(config, inputs.dataset, inputs.geometry, cameras)
