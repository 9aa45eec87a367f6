"""`light-path` as the page draws it: what light_ends.glsl, light_path.glsl and straight.glsl read."""

import numpy as np
from torch import nn

from datagen.scene.materials.optics import Medium, Surface
from datagen.scene.media import MAX_NESTED
from model.methods.light_path.config import LightPathConfig
from model.methods.light_path.net import RELIEF_DEPTH, LightPathRenderer
from model.methods.light_path.paths import STACKED_VERTICES
from model.nets.learned_sky import LOBE_RATE, LOBE_SHARPNESS, LearnedSky
from model.nets.texture import FINER_COUNTS, NeuralTextures, level_scales
from model.web.drawn import Drawn
from model.web.texels import fours
from model.web.weights import Rows, feature_columns, mlp_rows

SHADERS = (
    "rays.glsl",
    "optics.glsl",
    "networks.glsl",
    "light_ends.glsl",
    "light_path.glsl",
    "straight.glsl",
    "picture.glsl",
)

MAX_DEPTH = 24
"""Surfaces after which a branch is given up: what `LightPathTracer.trace` does unless told."""

STACK_BRANCHES, STACK_DEPTH = len(STACKED_VERTICES), max(STACKED_VERTICES)
"""Of the paths that the stack network is told of."""


def draw_light_path(renderer: LightPathRenderer, surfaces: list[Surface], media: list[Medium]) -> Drawn:
    """The renderer of a scene with these surfaces and media."""
    config = renderer.config
    weights = _networks(renderer)
    relief = None
    if renderer.relief is not None:
        relief = _relief_places(renderer.relief, sum(map(len, weights)))
        depths = renderer.relief.table.detach().cpu().numpy().astype(np.float32).ravel()
        weights.append(np.pad(depths, (0, fours(len(depths)) - len(depths))).reshape(-1, 4))
    straight = _straight(config)
    return Drawn(
        shaders=SHADERS,
        defines={
            "LIGHT_PATH": 1,
            "NORMALS": 1,
            # Where the stack network alone makes the colour, no other paths count.
            "BRANCHES": config.branches if config.composite else STACK_BRANCHES,
            "MAX_DEPTH": MAX_DEPTH if config.composite else STACK_DEPTH,
            "STACK_BRANCHES": STACK_BRANCHES,
            "STACK_DEPTH": STACK_DEPTH,
            "HIDDEN": fours(config.hidden),
            "STACK_HIDDEN": fours(config.stack_hidden),
            "SEES_DIRECTIONS": int(config.sees_directions),
            "OCTAVES": config.position_octaves,
            "COMPOSITE": int(config.composite),
            "SKY_HEIGHT": config.environment_size,
            "SKY_LEVELS": config.environment_size.bit_length() + 1,
            "LOBES": config.sky_lobes if config.composite else 0,
            "STRAIGHT": straight,
            "RELIEF": int(relief is not None),
            "RELIEF_DEPTH": RELIEF_DEPTH,
            # In the page any solid may be moved into any other.
            "NESTED": int(len(media) <= MAX_NESTED),
            "DISPERSES": int(any(len(set(medium.iors)) > 1 for medium in media)),
            "ROUGH_GLASS": int(any(surface.event == "refracts" and surface.roughness > 0 for surface in surfaces)),
        },
        textures=renderer.textures,
        features=fours(config.texture_features),
        weights=weights,
        samples=config.render_samples,
        shells=config.shells,
        relief=relief,
    )


def _straight(config: LightPathConfig) -> int:
    """Straight layers that count: only the stack network looks at them."""
    return config.straight_layers if config.stack_hidden else 0


def _networks(renderer: LightPathRenderer) -> list[Rows]:
    """Decoder, stack network, opacity of straight layers, sky."""
    config, features = renderer.config, renderer.config.texture_features
    others = 1 + (9 if config.sees_directions else 0) + 6 * config.position_octaves
    parts: list[Rows] = []
    if config.composite:
        parts += mlp_rows(renderer.decoder, feature_columns(features, others))
    else:
        parts += _no_mlp(config, others)
    if renderer.stack_net is not None:
        slots = sum(STACKED_VERTICES) + config.straight_layers
        columns = [at for slot in range(slots) for at in feature_columns(features, 2, slot * (features + 2))]
        if config.straight_layers:
            columns += [*range(slots * (features + 2), slots * (features + 2) + 3), -1]
        parts += mlp_rows(renderer.stack_net, columns)
    else:
        parts.append(np.zeros((1, 4), np.float32))  # The biases of a last layer that nothing reads.
    if config.composite:
        if _straight(config):
            assert renderer.cover is not None
            parts += mlp_rows(renderer.cover, feature_columns(features, 10))
        parts += _sky(renderer.environment)
    return parts


def _no_mlp(config: LightPathConfig, others: int) -> list[Rows]:
    """Room for a decoder that there is none of, so that what follows stands where the shader looks for it."""
    groups, inputs = fours(config.hidden) // 4, fours(config.texture_features) + others
    return [np.zeros((groups * (inputs + 1) + groups * (4 * groups + 1) + 4 * groups + 1, 4), np.float32)]


def _relief_places(relief: NeuralTextures, first_row: int) -> list[list[int]]:
    layout = relief.layout
    return [[4 * first_row + base, size, size, 0] for base, size in zip(layout.bases, layout.sizes)]


def _sky(sky: LearnedSky) -> list[Rows]:
    """The maps, finest first, row by row, times what each counts; then axis, sharpness and colour of each lobe."""
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
