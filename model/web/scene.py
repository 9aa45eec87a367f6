"""What the page holds of a scene: meshes, optics, texels, weights and cameras, as arrays and a manifest."""

from dataclasses import dataclass
from typing import cast

import numpy as np
import torch

from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.data.layers import UV_SCALE, quantize_uv, round_mantissa
from datagen.data.meshes import Mesh, is_there, open_edges
from datagen.data.paths import TRUTH
from datagen.disk.records import Json
from datagen.scene.description import CameraRig, Scene
from datagen.scene.edits import CLEAR_GLASS, GREY
from datagen.scene.folder import load_scene
from datagen.scene.materials import Material
from datagen.scene.thin_walls import MIN_COSINE as SKIP_COSINE
from datagen.scene.thin_walls import RAY_OFFSET
from datagen.trace.light_path import PLASTIC
from datagen.trace.surface_hits import MIN_COSINE
from datagen.trace.surface_tables import EVENTS
from datagen.trace.tints import tints_of
from model.methods.page import MethodPage, fours, package_text
from model.methods.protocol import MethodConfig
from model.methods.renderer import Renderer
from model.nets.pixel_mlp import LEAKY_SLOPE
from model.web.packing import NORMAL_STEPS, Packed, Quality, fold_normals, quantize_normals, quantize_positions
from model.web.texels import Places, TintPlaces, add_texels, add_tints


@dataclass(frozen=True, kw_only=True, eq=False)
class WebScene:
    """A trained scene, ready for the page."""

    manifest: dict[str, Json]
    packed: Packed
    shader: str
    """GLSL: the numbers that it shares with Python, then what all pages have, and the method's part in its place."""


def web_scene(renderer: Renderer, config: MethodConfig, dataset: Dataset, geometry: str, quality: Quality) -> WebScene:
    """All that the page needs to draw the scene of a trained renderer whose method has a page."""
    scene = load_scene(dataset.root / "scene", is_sealed=True)
    meshes = read_meshes(dataset, geometry)
    page = config.draw_page(renderer, scene)
    packed = Packed()
    boxes = _add_meshes(packed, meshes, quality, with_normals=page.has_normals)
    with torch.inference_mode():
        # A learned relief shifts look-ups to anywhere.
        charted = None if page.relief else [mesh for mesh in meshes for _ in range(page.shells)]
        places = add_texels(packed, page.textures, quality, charted)
    tints: TintPlaces = [None] * len(meshes)
    if page.follows_light:
        tints = add_tints(packed, tints_of(scene, own_uv=geometry == TRUTH), quality)
    weights = np.concatenate([np.zeros((0, 4), np.float32), *page.weights])
    packed.add("weights", round_mantissa(weights) if quality == "small" else weights)
    views: dict[str, Json] = {}
    for split in dataset.splits:
        cameras = dataset.cameras(split)
        packed.add(f"cameras/{split}", np.ascontiguousarray(cameras.world_from_camera[:, :3].reshape(-1, 12)))
        views[split] = len(cameras)
    target, reach = _orbit(scene, dataset)
    defines = _defines(page, levels=len(places[0]), has_tints=any(tints))
    manifest: dict[str, Json] = {
        "schema": 4,
        "name": dataset.name,
        "quality": quality,
        "samples": page.samples,
        "lens": _lens(dataset),
        "target": target,
        "reach": reach,
        "start": f"{'interpolating' if 'interpolating' in views else dataset.splits[0]}/0",
        "views": views,
        "shells": page.shells,
        "followsLight": page.follows_light,
        "normalSteps": NORMAL_STEPS,
        "uvSteps": UV_SCALE,
        "defines": cast(Json, defines),
        "edits": [{"name": "matt", **_optics(GREY)}, {"name": "clear glass", **_optics(CLEAR_GLASS)}],
        "objects": [{**item, **box} for item, box in zip(_objects(scene, meshes, page, places, tints), boxes)],
    }
    parts = (
        *(f"#define {name} {value}{'u' * (value > 0x7FFFFFFF)}" for name, value in defines.items()),
        package_text("model.web", "rays.glsl", "networks.glsl"),
        page.shader,
        package_text("model.web", "picture.glsl"),
    )
    return WebScene(manifest=manifest, packed=packed, shader="\n".join(parts))


def _defines(page: MethodPage, *, levels: int, has_tints: bool) -> dict[str, int | float]:
    """What the shader knows by name: constants of Python, the page's own choices, and the method's."""
    return {
        **{event.upper(): code for event, code in EVENTS.items()},
        "RAY_OFFSET": RAY_OFFSET,
        "SKIP_COSINE": SKIP_COSINE,
        "MIN_COSINE": MIN_COSINE,
        "LEAKY_SLOPE": LEAKY_SLOPE,
        # Steps of the R2 sequence, times 2^32.
        "R2_X": round(2**32 / PLASTIC),
        "R2_Y": round(2**32 / PLASTIC**2),
        "FEATURE_TEXELS": fours(next(page.textures.parameters()).shape[1]) // 4,
        "LEVELS": levels,
        "TINTS": int(has_tints),
        "NORMALS": int(page.has_normals),
        "LIGHT_PATH": int(page.follows_light),
        "RELIEF": int(page.relief is not None),
        **page.defines,
    }


def _lens(dataset: Dataset) -> dict[str, Json]:
    """In focal lengths: half the width and height of the dataset's pictures, and how far right of their middle, and
    below it, the principal point is."""
    cameras = dataset.cameras(dataset.splits[0])
    half = [cameras.width / 2, cameras.height / 2]
    shift = [(at - middle) / cameras.focal for at, middle in zip(cameras.principal_point, half, strict=True)]
    return {"half": [side / cameras.focal for side in half], "shift": cast(Json, shift)}


def _orbit(scene: Scene, dataset: Dataset) -> tuple[list[Json], float]:
    """The point that the page's camera turns about, and half of how far the dataset's cameras are from it, metres."""
    if isinstance(scene.cameras, CameraRig):
        return list(scene.cameras.target), scene.cameras.radius / 2
    vertices = np.concatenate([item.mesh.vertices for item in scene.objects])
    target = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    places = dataset.cameras(dataset.splits[0]).world_from_camera[:, :3, 3]
    return [float(value) for value in target], float(np.linalg.norm(places - target, axis=1).mean() / 2)


def _objects(
    scene: Scene, meshes: tuple[Mesh, ...], page: MethodPage, places: Places, tints: TintPlaces
) -> list[dict[str, Json]]:
    """What the page is told of each object, in the order of their ids."""
    listed: list[dict[str, Json]] = []
    first_vertex = first_face = 0
    for index, (item, mesh) in enumerate(zip(scene.objects, meshes, strict=True)):
        shells = slice(index * page.shells, (index + 1) * page.shells)
        listed.append(
            {
                "name": item.name,
                "firstVertex": first_vertex,
                "numVertices": len(mesh.vertices),
                "firstFace": first_face,
                "numFaces": len(mesh.faces),
                "isClosed": is_there(mesh) and open_edges(mesh) == 0,
                **_optics(item.material, tints[index]),
                "texels": cast(Json, places[shells]),
                "relief": None if page.relief is None else cast(Json, page.relief[shells]),
            }
        )
        first_vertex, first_face = first_vertex + len(mesh.vertices), first_face + len(mesh.faces)
    return listed


def _optics(material: Material, tint: list[int] | None = None) -> dict[str, Json]:
    """What the page is told of a material."""
    surface, medium = material.surface(), material.medium
    return {
        "event": surface.event,
        "ior": surface.ior,
        "roughness": surface.roughness,
        "color": list(surface.color),
        "tint": cast(Json, tint),
        "priority": None if medium is None else medium.priority,
        "mediumIor": 1.0 if medium is None else medium.ior,
        "spread": [0.0, 0.0, 0.0] if medium is None else [ior - medium.ior for ior in medium.iors],
        "absorption": [0.0, 0.0, 0.0] if medium is None else list(medium.absorption),
    }


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
