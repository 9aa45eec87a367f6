"""What the page holds of a scene: meshes, optics, texels, weights and cameras, as arrays and a manifest."""

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch

from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.data.meshes import Mesh, is_there, open_edges
from datagen.data.number_formats import quantize_uv, round_mantissa
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.scene.description import CameraRig, Scene
from datagen.scene.folder import load_scene
from datagen.scene.thin_walls import RAY_OFFSET
from datagen.trace.tints import tints_of
from model.methods.light_path.net import LightPathRenderer
from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer
from model.methods.protocol import MethodConfig
from model.methods.renderer import Renderer
from model.web.drawn import Drawn
from model.web.light_path import draw_light_path
from model.web.packing import Packed, Quality, fold_normals, quantize_normals, quantize_positions
from model.web.paper import draw_paper
from model.web.texels import Places, add_texels
from model.web.tints import TintPlaces, add_tints


@dataclass(frozen=True, kw_only=True, eq=False)
class WebScene:
    """A trained scene, ready for the page."""

    manifest: dict[str, Json]
    packed: Packed
    shaders: tuple[str, ...]


def web_scene(renderer: Renderer, config: MethodConfig, dataset: Dataset, geometry: str, quality: Quality) -> WebScene:
    """All that the page needs to draw a trained renderer's scene.

    Raises:
        HyalineError: the page cannot draw runs of this method.
    """
    scene = load_scene(dataset.root / "scene", is_sealed=True)
    meshes = read_meshes(dataset, geometry)
    drawn = _draw(renderer, config, scene)
    packed = Packed()
    boxes = _add_meshes(packed, meshes, quality, with_normals=bool(drawn.defines["NORMALS"]))
    with torch.inference_mode():
        # A learned relief shifts look-ups to anywhere.
        charted = None if drawn.relief else [mesh for mesh in meshes for _ in range(drawn.shells)]
        places = add_texels(packed, drawn.textures, quality, charted)
    tints: TintPlaces = [None] * len(meshes)
    if drawn.knows_materials:
        tints = add_tints(packed, tints_of(scene, own_uv=geometry == TRUTH), quality)
    weights = np.concatenate(drawn.weights)
    packed.add("weights", round_mantissa(weights) if quality == "small" else weights)
    views: dict[str, Json] = {}
    for split in dataset.splits:
        cameras = dataset.cameras(split)
        packed.add(f"cameras/{split}", np.ascontiguousarray(cameras.world_from_camera[:, :3].reshape(-1, 12)))
        views[split] = len(cameras)
    target, reach = _orbit(scene, dataset)
    manifest: dict[str, Json] = {
        "schema": 3,
        "name": dataset.name,
        "quality": quality,
        "samples": drawn.samples,
        "lens": _lens(dataset),
        "target": target,
        "reach": reach,
        "start": f"{'interpolating' if 'interpolating' in views else dataset.splits[0]}/0",
        "views": views,
        "shells": drawn.shells,
        "knowsMaterials": drawn.knows_materials,
        "defines": {
            **drawn.defines,
            "LEVELS": len(places[0]),
            "RAY_OFFSET": RAY_OFFSET,
            "FEATURE_TEXELS": drawn.features // 4,
            "TINTS": int(any(tints)),
        },
        "objects": [{**item, **box} for item, box in zip(_objects(scene, meshes, drawn, places, tints), boxes)],
    }
    return WebScene(manifest=manifest, packed=packed, shaders=drawn.shaders)


def _draw(renderer: Renderer, config: MethodConfig, scene: Scene) -> Drawn:
    if isinstance(renderer, LightPathRenderer):
        surfaces = [item.material.surface() for item in scene.objects]
        media = [item.material.medium for item in scene.objects if item.material.medium is not None]
        return draw_light_path(renderer, surfaces, media)
    if isinstance(renderer, PaperRenderer) and isinstance(config, PaperConfig):
        return draw_paper(renderer, config)
    raise HyalineError(
        f"export: the run is one of {type(renderer).__name__}; expected light-path, paper or mlp-first, which a page "
        "can draw"
    )


def _lens(dataset: Dataset) -> dict[str, Json]:
    """In focal lengths: half the width and height of the dataset's pictures, and how far right of their middle, and
    below it, the principal point is."""
    cameras = dataset.cameras(dataset.splits[0])
    half = [cameras.width / 2, cameras.height / 2]
    focal = half[0] / math.tan(cameras.fov_x / 2)
    shift = [(at - middle) / focal for at, middle in zip(cameras.principal_point, half, strict=True)]
    return {"half": [side / focal for side in half], "shift": cast(Json, shift)}


def _orbit(scene: Scene, dataset: Dataset) -> tuple[list[Json], float]:
    """The point that the page's camera turns about, and half of how far the dataset's cameras are from it, metres."""
    if isinstance(scene.cameras, CameraRig):
        return list(scene.cameras.target), scene.cameras.radius / 2
    vertices = np.concatenate([item.mesh.vertices for item in scene.objects])
    target = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    places = dataset.cameras(dataset.splits[0]).world_from_camera[:, :3, 3]
    return [float(value) for value in target], float(np.linalg.norm(places - target, axis=1).mean() / 2)


def _objects(
    scene: Scene, meshes: tuple[Mesh, ...], drawn: Drawn, places: Places, tints: TintPlaces
) -> list[dict[str, Json]]:
    """What the page is told of each object, in the order of their ids."""
    listed: list[dict[str, Json]] = []
    first_vertex = first_face = 0
    for index, (item, mesh) in enumerate(zip(scene.objects, meshes, strict=True)):
        surface, medium = item.material.surface(), item.material.medium
        shells = slice(index * drawn.shells, (index + 1) * drawn.shells)
        listed.append(
            {
                "name": item.name,
                "firstVertex": first_vertex,
                "numVertices": len(mesh.vertices),
                "firstFace": first_face,
                "numFaces": len(mesh.faces),
                "isClosed": is_there(mesh) and open_edges(mesh) == 0,
                "event": surface.event,
                "ior": surface.ior,
                "roughness": surface.roughness,
                "color": list(surface.color),
                "tint": cast(Json, tints[index]),
                "priority": None if medium is None else medium.priority,
                "mediumIor": 1.0 if medium is None else medium.ior,
                "spread": [0.0, 0.0, 0.0] if medium is None else [ior - medium.ior for ior in medium.iors],
                "absorption": [0.0, 0.0, 0.0] if medium is None else list(medium.absorption),
                "texels": cast(Json, places[shells]),
                "relief": None if drawn.relief is None else cast(Json, drawn.relief[shells]),
            }
        )
        first_vertex, first_face = first_vertex + len(mesh.vertices), first_face + len(mesh.faces)
    return listed


def _add_meshes(
    packed: Packed, meshes: tuple[Mesh, ...], quality: Quality, *, with_normals: bool
) -> list[dict[str, Json]]:
    """Adds all meshes, one behind the other; what the page has to know of each to place its vertices."""

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(mesh, name) for mesh in meshes])

    is_small, boxes = quality == "small", [{} for _ in meshes]
    if is_small:
        codes, lows, steps = zip(*(quantize_positions(mesh.vertices) for mesh in meshes), strict=True)
        packed.add("vertices", np.concatenate(codes), differences=True)
        boxes = [{"low": cast(Json, low), "step": cast(Json, step)} for low, step in zip(lows, steps)]
    else:
        packed.add("vertices", joined("vertices"))
    packed.add("faces", joined("faces").astype(np.uint32), differences=True)
    normals, uv = joined("normals"), joined("uv")
    if with_normals:
        packed.add("normals", quantize_normals(normals) if is_small else fold_normals(normals), differences=is_small)
    packed.add("uv", quantize_uv(uv) if is_small else uv, differences=is_small)
    return boxes
