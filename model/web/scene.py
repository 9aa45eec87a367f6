"""What a page of `light-path` holds: meshes, optics, texels, weights and cameras, as arrays and a manifest."""

import math
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
import torch
from jaxtyping import Float32, Int32, UInt8
from torch import Tensor, nn

from datagen.data.cameras import Cameras
from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.data.meshes import Mesh, is_there
from datagen.data.number_formats import quantize_uv
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.scene.description import CameraRig, Scene
from datagen.scene.folder import load_scene
from datagen.scene.media import MAX_NESTED, find_media
from model.methods.light_path.config import LightPathConfig
from model.methods.light_path.net import LightPathRenderer
from model.methods.light_path.paths import STACKED_VERTICES
from model.nets.learned_sky import LOBE_RATE, LOBE_SHARPNESS, LearnedSky
from model.nets.texture import FINER_COUNTS, level_scales
from model.web.packing import Packed, fold_normals, quantize_normals

Quality = Literal["small", "exact"]

MAX_DEPTH = 24
"""Surfaces after which a branch is given up: what `LightPathTracer.trace` does unless told."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WebScene:
    """A trained scene, ready for the page."""

    manifest: dict[str, Json]
    packed: Packed


def check_exportable(config: LightPathConfig) -> None:
    """Refuses what the page's shader does not compute.

    Raises:
        HyalineError: naming it.
    """
    if config.straight_layers or config.relief == "on" or config.shells > 1:
        raise HyalineError(
            "export: the run sees straight layers, shells or relief, as runs on proxies do; expected light-path on "
            "the true geometry, which is what the page can draw"
        )


def web_scene(renderer: LightPathRenderer, dataset: Dataset, geometry: str, quality: Quality) -> WebScene:
    """All that the page needs to draw a trained renderer's scene."""
    config = renderer.config
    check_exportable(config)
    scene = load_scene(dataset.root / "scene", is_sealed=True)
    meshes = read_meshes(dataset, geometry)
    packed = Packed()
    _add_meshes(packed, meshes, quality)
    with torch.inference_mode():
        places = _add_texels(packed, renderer, quality)
        packed.add("weights", _weights(renderer))
    views: dict[str, Json] = {}
    for split in dataset.splits:
        cameras = dataset.cameras(split)
        packed.add(f"cameras/{split}", np.ascontiguousarray(cameras.world_from_camera[:, :3].reshape(-1, 12)))
        views[split] = len(cameras)
    # Of objects that are not there the place in the order does not matter, but their boxes have no bounds.
    there = tuple(item.material if is_there(mesh) else None for item, mesh in zip(scene.objects, meshes, strict=True))
    rank = find_media(there, meshes).rank
    target, reach = _orbit(scene, dataset)
    surfaces = [item.material.surface() for item in scene.objects]
    manifest: dict[str, Json] = {
        "schema": 1,
        "name": dataset.name,
        "quality": quality,
        "samples": config.render_samples,
        "fov": _shorter_angle(dataset.cameras(dataset.splits[0])),
        "target": target,
        "reach": reach,
        "start": f"{'interpolating' if 'interpolating' in views else dataset.splits[0]}/0",
        "views": views,
        "defines": {
            **_defines(config, quality),
            # In the page any solid may be moved into any other.
            "NESTED": int(int((rank >= 0).sum()) <= MAX_NESTED),
            "ROUGH_GLASS": int(any(surface.event == "refracts" and surface.roughness > 0 for surface in surfaces)),
        },
        "objects": _objects(scene, meshes, rank, places),
    }
    return WebScene(manifest=manifest, packed=packed)


def _shorter_angle(cameras: Cameras) -> float:
    """Field of view in radians along a picture's shorter side, which the page keeps whatever its window's shape is."""
    if cameras.width <= cameras.height:
        return cameras.fov_x
    return 2 * math.atan(math.tan(cameras.fov_x / 2) * cameras.height / cameras.width)


def _orbit(scene: Scene, dataset: Dataset) -> tuple[list[Json], float]:
    """The point that the page's camera turns about, and half of how far the dataset's cameras are from it, metres."""
    if isinstance(scene.cameras, CameraRig):
        return list(scene.cameras.target), scene.cameras.radius / 2
    vertices = np.concatenate([item.mesh.vertices for item in scene.objects])
    target = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    places = dataset.cameras(dataset.splits[0]).world_from_camera[:, :3, 3]
    return [float(value) for value in target], float(np.linalg.norm(places - target, axis=1).mean() / 2)


def _defines(config: LightPathConfig, quality: Quality) -> dict[str, Json]:
    """The numbers that stand above the shader."""
    return {
        "BRANCHES": config.branches,
        "MAX_DEPTH": MAX_DEPTH,
        "LEVELS": config.texture_levels if quality == "exact" else 1,
        "FEATURE_TEXELS": _fours(config.texture_features) // 4,
        "HIDDEN": _fours(config.hidden),
        "STACK_HIDDEN": _fours(config.stack_hidden),
        "SEES_DIRECTIONS": int(config.sees_directions),
        "OCTAVES": config.position_octaves,
        "COMPOSITE": int(config.composite),
        "SKY_HEIGHT": config.environment_size,
        "SKY_LEVELS": config.environment_size.bit_length() + 1,
        "LOBES": config.sky_lobes if config.composite else 0,
    }


def _objects(
    scene: Scene, meshes: tuple[Mesh, ...], ranks: Int32[np.ndarray, "object"], places: list[list[list[int]]]
) -> list[Json]:
    """What the page is told of each object, in the order of their ids."""
    listed: list[Json] = []
    first_vertex = first_face = 0
    for index, (item, mesh) in enumerate(zip(scene.objects, meshes, strict=True)):
        surface, medium, rank = item.material.surface(), item.material.medium, int(ranks[index])
        listed.append(
            {
                "name": item.name,
                "firstVertex": first_vertex,
                "numVertices": len(mesh.vertices),
                "firstFace": first_face,
                "numFaces": len(mesh.faces),
                "event": surface.event,
                "ior": surface.ior,
                "roughness": surface.roughness,
                "color": list(surface.color),
                "rank": rank,
                "mediumIor": 1.0 if medium is None else medium.ior,
                "absorption": [0.0, 0.0, 0.0] if medium is None else list(medium.absorption),
                "texels": cast(Json, places[index]),
            }
        )
        first_vertex, first_face = first_vertex + len(mesh.vertices), first_face + len(mesh.faces)
    return listed


def _add_meshes(packed: Packed, meshes: tuple[Mesh, ...], quality: Quality) -> None:
    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(mesh, name) for mesh in meshes])

    packed.add("vertices", joined("vertices"))
    packed.add("faces", joined("faces").astype(np.uint32), differences=True)
    normals, uv = joined("normals"), joined("uv")
    packed.add("normals", quantize_normals(normals) if quality == "small" else fold_normals(normals))
    packed.add("uv", quantize_uv(uv) if quality == "small" else uv)


def _add_texels(packed: Packed, renderer: LightPathRenderer, quality: Quality) -> list[list[list[int]]]:
    """The neural textures: every level as it is, or their sum at the finest one's texels, in bytes.

    Returns:
        For each object and level: the first texel and the width.
    """
    config, textures = renderer.config, renderer.textures
    layouts = [level.layout for level in textures.levels()]
    if quality == "exact":
        scales = level_scales(len(layouts), FINER_COUNTS)
        tables = [_padded(scale * table) for scale, table in zip(scales, textures.tables())]
        packed.add("texels", np.concatenate(tables))
        firsts = np.cumsum([0, *(len(table) for table in tables)])
        return [
            [[int(first) + layout.bases[index], layout.sizes[index]] for first, layout in zip(firsts, layouts)]
            for index in range(len(config.texture_sizes))
        ]
    sums = [_padded(_summed(renderer, index, size)) for index, size in enumerate(layouts[0].sizes)]
    low = np.stack([values.min(axis=0) for values in sums])
    step = np.maximum(np.stack([values.max(axis=0) for values in sums]) - low, 1e-12) / np.float32(255)
    codes: list[UInt8[np.ndarray, "texel c"]] = [
        np.rint((values - low[index]) / step[index]).clip(0, 255).astype(np.uint8) for index, values in enumerate(sums)
    ]
    packed.add("texels", np.concatenate(codes))
    packed.add("texelLow", low)
    packed.add("texelStep", step)
    return [[[layouts[0].bases[index], size]] for index, size in enumerate(layouts[0].sizes)]


def _summed(renderer: LightPathRenderer, index: int, size: int) -> Tensor:
    """The features of an object (counted from 0) at the centres of its finest texels."""
    row, column = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    uv = torch.stack([(column + 0.5) / size, 1 - (row + 0.5) / size], dim=-1).reshape(-1, 1, 2)
    return renderer.textures(uv, torch.full((size * size, 1), index + 1, dtype=torch.uint8))[:, 0]


def _fours(count: int) -> int:
    """The next multiple of 4: textures hold four numbers in each place."""
    return -(-count // 4) * 4


def _padded(features: Tensor) -> Float32[np.ndarray, "texel c"]:
    values = features.cpu().numpy().astype(np.float32)
    return np.pad(values, ((0, 0), (0, _fours(values.shape[1]) - values.shape[1])))


def _weights(renderer: LightPathRenderer) -> Float32[np.ndarray, "place 4"]:
    """All networks, then the sky, in the order in which tracer.glsl reads them."""
    config = renderer.config
    parts: list[np.ndarray] = []
    features, more = config.texture_features, _fours(config.texture_features) - config.texture_features
    if config.composite:
        inputs = features + 1 + (9 if config.sees_directions else 0) + 6 * config.position_octaves
        parts += _mlp(renderer.decoder, [*range(features), *[-1] * more, *range(features, inputs)])
    else:
        parts += _no_mlp(config)
    if renderer.stack_net is not None:
        slot = features + 2
        order = [*range(features), *[-1] * more, features, features + 1]
        columns = [-1 if at < 0 else place * slot + at for place in range(sum(STACKED_VERTICES)) for at in order]
        parts += _mlp(renderer.stack_net, columns)
    else:
        parts.append(np.zeros((1, 4), np.float32))  # The biases of a last layer that nothing reads.
    if config.composite:
        parts += _sky(renderer.environment)
    return np.concatenate(parts)


def _no_mlp(config: LightPathConfig) -> list[np.ndarray]:
    """Room for a decoder that there is none of, so that what follows stands where the shader looks for it."""
    groups, inputs = _fours(config.hidden) // 4, _fours(config.texture_features) + 1
    inputs += (9 if config.sees_directions else 0) + 6 * config.position_octaves
    return [np.zeros((groups * (inputs + 1) + groups * (4 * groups + 1) + 4 * groups + 1, 4), np.float32)]


def _mlp(net: nn.Sequential, columns: list[int]) -> list[Float32[np.ndarray, "place 4"]]:
    """Weights and biases of three layers: for four outputs at once, input by input; units come in fours.

    Args:
        columns: which input of the first layer stands in each place; -1 for none.
    """
    layers = [layer for layer in net if isinstance(layer, nn.Linear)]
    parts = []
    for place, layer in enumerate(layers):
        weight, bias = (value.detach().cpu().numpy().astype(np.float32) for value in (layer.weight, layer.bias))
        if place == 0:
            weight = np.concatenate([weight, np.zeros((len(weight), 1), np.float32)], axis=1)[:, columns]
        else:
            weight = np.pad(weight, ((0, 0), (0, _fours(weight.shape[1]) - weight.shape[1])))
        weight, bias = (
            np.pad(values, ((0, _fours(len(values)) - len(values)), *[(0, 0)] * (values.ndim - 1)))
            for values in (weight, bias)
        )
        parts += [weight.reshape(-1, 4, weight.shape[1]).transpose(0, 2, 1).reshape(-1, 4), bias.reshape(-1, 4)]
    return parts


def _sky(sky: LearnedSky) -> list[Float32[np.ndarray, "place 4"]]:
    """The maps, finest first, row by row, times what each counts; then axis, sharpness and colour of each lobe."""
    scales = level_scales(sky.num_maps, FINER_COUNTS)
    parts = [
        np.pad((scale * texels).cpu().numpy().reshape(3, -1).T, ((0, 0), (0, 1)))
        for scale, texels in zip(scales, sky.maps)
    ]
    if sky.lobes is not None:
        axis = nn.functional.normalize(sky.lobes.axis, dim=1)
        sharpness = LOBE_SHARPNESS * torch.exp(LOBE_RATE * sky.lobes.sharpness)
        color = nn.functional.softplus(3 * LOBE_RATE * sky.lobes.brightness)
        lobes = torch.cat([axis, sharpness[:, None], color, torch.zeros(len(color), 1)], dim=1)
        parts.append(lobes.cpu().numpy().reshape(-1, 4))
    return [part.astype(np.float32) for part in parts]
