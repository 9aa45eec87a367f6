"""The web page of `light-path`: its shaders, the numbers that they share with Python, and its weights."""

import numpy as np
from torch import nn

from datagen.render.albedo import ALPHAS, COSINES, INDICES, albedo_table
from datagen.scene.description import Scene
from datagen.scene.media import MAX_NESTED, SAME_INDEX
from datagen.trace.branches import FIRST_MIRROR, SPARE_STEPS
from datagen.trace.surface_tables import LIMITS
from model.methods.light_path.config import LightPathConfig
from model.methods.light_path.net import RELIEF_DEPTH, STACK_SHIFT, LightPathRenderer
from model.methods.light_path.pixels import MANY_RAYS, STACKED_VERTICES
from model.methods.page import MethodPage, Rows, feature_columns, fours, mlp_rows, package_text
from model.nets.learned_sky import LOBE_RATE, LOBE_SHARPNESS, LearnedSky
from model.nets.texture import level_scales

SHADERS = ("optics.glsl", "light_ends.glsl", "light_path.glsl", "straight.glsl")


def draw_page(config: LightPathConfig, renderer: LightPathRenderer, scene: Scene) -> MethodPage:
    """The renderer of a scene with these surfaces and media."""
    weights = _networks(renderer)
    relief = None
    if renderer.relief is not None:
        layout, first = renderer.relief.layout, 4 * sum(map(len, weights))
        relief = [[first + base, size, size, 0] for base, size in zip(layout.bases, layout.sizes)]
        depths = renderer.relief.table.detach().cpu().numpy().astype(np.float32).ravel()
        weights.append(np.pad(depths, (0, fours(len(depths)) - len(depths))).reshape(-1, 4))
    defines = {**_defines(config, scene), "ALBEDO": sum(map(len, weights))}
    weights.append(albedo_table().reshape(-1, 4))
    return MethodPage(
        shader=package_text("model.methods.light_path", *SHADERS),
        defines=defines,
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
        "ALBEDO_INDICES": INDICES,
        "ALBEDO_ALPHAS": ALPHAS,
        "ALBEDO_COSINES": COSINES,
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
        "STRAIGHT": config.seen_straight,
        "RELIEF_DEPTH": RELIEF_DEPTH,
        "MAX_NESTED": MAX_NESTED,
        # In the page any solid may be moved into any other.
        "NESTED": int(len(media) <= MAX_NESTED),
        "DISPERSES": int(any(len(set(medium.iors)) > 1 for medium in media)),
        "ROUGH_GLASS": int(any(surface.event == "refracts" and surface.roughness > 0 for surface in surfaces)),
    }


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
    if config.seen_straight:
        assert renderer.cover is not None
        parts += mlp_rows(renderer.cover, feature_columns(features, 10))
    return [*parts, *_sky(renderer.environment)]


def _sky(sky: LearnedSky) -> list[Rows]:
    """The maps times their weights, finest first, row by row; then axis, sharpness and colour of each lobe."""
    scales = level_scales(sky.num_maps, sky.finer_counts)
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
