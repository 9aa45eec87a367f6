"""How `light-path` is made: what the dataset decides, the renderer, the pixels, and the web page."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from torch import nn

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.dataset import check_has_meshes
from datagen.disk.errors import HyalineError
from datagen.scene.description import EnvironmentMap, Scene, image_bytes
from datagen.scene.folder import open_scene
from datagen.scene.images import read_map
from datagen.scene.media import MAX_NESTED, SAME_INDEX
from datagen.trace.branches import FIRST_MIRROR, SPARE_STEPS
from datagen.trace.surface_tables import LIMITS
from model.methods.light_path.config import MAX_SKY_HEIGHT, SKY_HEIGHT, LightPathConfig
from model.methods.light_path.net import RELIEF_DEPTH, STACK_SHIFT, LightPathRenderer
from model.methods.light_path.pixels import (
    MANY_RAYS,
    STACKED_VERTICES,
    LightPathPixels,
    load_light_path_pixels,
    share_texels,
    trace_light_paths,
)
from model.methods.page import MethodPage, Rows, feature_columns, fours, mlp_rows, package_text
from model.methods.protocol import Inputs
from model.nets.learned_sky import LOBE_RATE, LOBE_SHARPNESS, LearnedSky
from model.nets.texture import FINER_COUNTS, NeuralTextures, level_scales

SHADERS = ("optics.glsl", "light_ends.glsl", "light_path.glsl", "straight.glsl")


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


def draw_page(config: LightPathConfig, renderer: LightPathRenderer, scene: Scene) -> MethodPage:
    """The renderer of a scene with these surfaces and media."""
    weights = _networks(renderer)
    relief = None
    if renderer.relief is not None:
        relief = _relief_places(renderer.relief, sum(map(len, weights)))
        depths = renderer.relief.table.detach().cpu().numpy().astype(np.float32).ravel()
        weights.append(np.pad(depths, (0, fours(len(depths)) - len(depths))).reshape(-1, 4))
    return MethodPage(
        shader=package_text("model.methods.light_path", *SHADERS),
        defines=_defines(config, scene),
        textures=renderer.textures,
        weights=weights,
        samples=config.render_samples,
        shells=config.shells,
        relief=relief,
        has_normals=True,
        follows_light=True,
    )


def _defines(config: LightPathConfig, scene: Scene) -> dict[str, int | float]:
    surfaces = [item.material.surface() for item in scene.objects]
    media = [item.material.medium for item in scene.objects if item.material.medium is not None]
    stacked_first, stacked_second = STACKED_VERTICES
    return {
        "BRANCHES": config.branches,
        "MAX_DEPTH": LIMITS.max_depth,
        "MIN_THROUGHPUT": LIMITS.min_throughput,
        "FIRST_MIRROR": FIRST_MIRROR,
        "SPARE_STEPS": SPARE_STEPS,
        "SAME_INDEX": SAME_INDEX,
        "MANY_RAYS": MANY_RAYS,
        "STACKED_FIRST": stacked_first,
        "STACKED_SECOND": stacked_second,
        "STACK_HIDDEN": fours(config.stack_hidden),
        "STACK_SHIFT": STACK_SHIFT,
        "HIDDEN": fours(config.hidden),
        "SEES_DIRECTIONS": int(config.directions),
        "SKY_HEIGHT": config.environment_size,
        "SKY_LEVELS": config.environment_size.bit_length() + 1,
        "LOBES": config.sky_lobes,
        "STRAIGHT": _straight(config),
        "RELIEF_DEPTH": RELIEF_DEPTH,
        "MAX_NESTED": MAX_NESTED,
        # In the page any solid may be moved into any other.
        "NESTED": int(len(media) <= MAX_NESTED),
        "DISPERSES": int(any(len(set(medium.iors)) > 1 for medium in media)),
        "ROUGH_GLASS": int(any(surface.event == "refracts" and surface.roughness > 0 for surface in surfaces)),
    }


def _straight(config: LightPathConfig) -> int:
    """Straight layers that matter: only the stack network uses them."""
    return config.straight_layers if config.stack_hidden else 0


def _networks(renderer: LightPathRenderer) -> list[Rows]:
    """Decoder, stack network, opacity of straight layers, sky."""
    config, features = renderer.config, renderer.config.texture_features
    parts = mlp_rows(renderer.decoder, feature_columns(features, 1 + (9 if config.directions else 0)))
    if renderer.stack_net is not None:
        slots = sum(STACKED_VERTICES) + config.straight_layers
        columns = [at for slot in range(slots) for at in feature_columns(features, 2, slot * (features + 2))]
        if config.straight_layers:
            columns += [*range(slots * (features + 2), slots * (features + 2) + 3), -1]
        parts += mlp_rows(renderer.stack_net, columns)
    else:
        parts.append(np.zeros((1, 4), np.float32))  # The biases of a last layer that nothing reads.
    if _straight(config):
        assert renderer.cover is not None
        parts += mlp_rows(renderer.cover, feature_columns(features, 10))
    return [*parts, *_sky(renderer.environment)]


def _relief_places(relief: NeuralTextures, first_row: int) -> list[list[int]]:
    layout = relief.layout
    return [[4 * first_row + base, size, size, 0] for base, size in zip(layout.bases, layout.sizes)]


def _sky(sky: LearnedSky) -> list[Rows]:
    """The maps times their weights, finest first, row by row; then axis, sharpness and colour of each lobe."""
    scales = level_scales(sky.num_maps, FINER_COUNTS)
    parts = [
        np.pad((scale * texels).detach().cpu().numpy().reshape(3, -1).T, ((0, 0), (0, 1)))
        for scale, texels in zip(scales, sky.maps)
    ]
    if sky.lobes is not None:
        axis = nn.functional.normalize(sky.lobes.axis, dim=1)
        sharpness = LOBE_SHARPNESS * (LOBE_RATE * sky.lobes.sharpness).exp()
        color = nn.functional.softplus(3 * LOBE_RATE * sky.lobes.brightness)
        lobes = [axis, sharpness[:, None], color, 0 * sharpness[:, None]]
        parts.append(np.concatenate([part.detach().cpu().numpy() for part in lobes], axis=1).reshape(-1, 4))
    return [part.astype(np.float32) for part in parts]
