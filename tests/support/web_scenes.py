"""A scene of every kind of surface, and renderers full of noise for it: what pages are compared with Python on."""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import trimesh
from support.meshes import mesh_of
from support.synthetic import look_at, quad, synthetic_scene
from torch import nn

from benchmarks.browser import Watched, open_file, watched_page
from datagen.data.cameras import Cameras
from datagen.data.config import SPLITS, DatasetConfig, DatasetObject, Resolution
from datagen.data.dataset import Dataset
from datagen.data.images import png_bytes
from datagen.data.meshes import Mesh
from datagen.data.paths import TRUTH
from datagen.data.writing import write_head
from datagen.scene.description import Scene, SceneObject
from datagen.scene.folder import scene_files
from datagen.scene.materials import (
    Conductor,
    Dielectric,
    Diffuse,
    ImageTexture,
    Plastic,
    RoughDielectric,
    ThinDielectric,
)
from datagen.trace.light_path import LightPathTracer
from datagen.trace.surface_tables import tints_of
from model.methods.light_path.config import LightPathConfig
from model.methods.light_path.net import LightPathRenderer
from model.methods.light_path.pixels import LightPathPixels
from model.methods.protocol import open_inputs
from model.nets.texture import TexturePyramid
from model.run.predict import predict_pixels

if TYPE_CHECKING:
    from playwright.sync_api import Browser

SHAPE = (44, 36)
VIEW = "interpolating/0"
METAL = 4
"""Its place among the objects."""
POSE = look_at(np.array([0.5, -2.2, 1.7]), np.array([-0.1, 0, 0.4]))
STILL = png_bytes(np.full((4, 4, 3), 90, np.uint8))


def placed(shape: trimesh.Trimesh, *place: float) -> Mesh:
    """A shape where it is to stand, with uv that change slowly; normals are those of faces where there are edges."""
    if len(shape.faces) < 1000:
        shape.unmerge_vertices()
    mesh = mesh_of(shape.apply_translation(place))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return dataclasses.replace(mesh, uv=((mesh.vertices - low) / (high - low))[:, [0, 2]].copy())


def post(radius: float, height: float, *place: float) -> Mesh:
    """An upright cylinder whose wall is smooth: its normals are exactly level."""
    mesh = placed(trimesh.creation.cylinder(radius, height, sections=24), *place)
    is_wall = np.abs(mesh.normals[:, 2]) < 0.5
    level = (mesh.vertices - np.float32(place)) * np.float32([1, 1, 0])
    level /= np.maximum(np.linalg.norm(level, axis=-1, keepdims=True), np.float32(1e-6))
    return dataclasses.replace(mesh, normals=np.where(is_wall[:, None], level, mesh.normals).astype(np.float32))


def standing_pane() -> Mesh:
    flat = quad(0)
    vertices = flat.vertices[:, [0, 2, 1]] * np.float32(0.6) + np.float32([0, -0.7, 0.7])
    return dataclasses.replace(flat, vertices=vertices, normals=np.tile(np.float32([0, -1, 0]), (4, 1)))


def every_surface() -> Scene:
    """Every kind of surface: a drink in a glass whose wall it reaches into, a pane, metal, plastic, ice, floor."""
    grey = (0.5, 0.5, 0.5)
    tall = {"glass": (0.45, 0.9), "drink": (0.4, 0.7)}
    cups = {
        name: placed(trimesh.creation.cylinder(radius, height, sections=24), 0.2, 0.1, 0.5)
        for name, (radius, height) in tall.items()
    }
    drink = Dielectric(ior=1.33, absorption=(0.3, 2, 3), priority=1)
    objects = (
        SceneObject(name="floor", mesh=quad(0), material=Diffuse(color=grey)),
        SceneObject(
            name="glass", mesh=cups["glass"], material=Dielectric(absorption=(0.2, 0.1, 0.3), tint=(0.9, 1, 0.8))
        ),
        SceneObject(name="drink", mesh=cups["drink"], material=drink),
        SceneObject(name="pane", mesh=standing_pane(), material=ThinDielectric(ior=1.5, tint=(0.9, 0.8, 0.7))),
        SceneObject(
            name="metal",
            mesh=placed(trimesh.creation.icosphere(3, 0.3), -0.6, 0.3, 0.35),
            material=Conductor(color=ImageTexture(path="metal.png"), roughness=0.2),
        ),
        SceneObject(
            name="plastic",
            mesh=placed(trimesh.creation.icosphere(3, 0.25), -0.5, -0.4, 0.3),
            material=Plastic(color=grey, ior=1.5, roughness=0.1),
        ),
        SceneObject(
            name="ice",
            mesh=placed(trimesh.creation.icosphere(3, 0.2), 0.4, -0.9, 0.25),
            material=RoughDielectric(ior=1.31, roughness=0.15, tint=(0.8, 0.9, 1)),
        ),
    )
    picture = np.random.default_rng(1).choice(np.array([0, 255], np.uint8), (5, 7, 3))
    return dataclasses.replace(synthetic_scene(), objects=objects, baked={"metal.png": png_bytes(picture)})


def write_scene(root: Path, scene: Scene, pose: np.ndarray = POSE) -> Dataset:
    """A scene with one camera in each split, without any picture."""
    height, width = SHAPE
    config = DatasetConfig.even("web", Resolution(width=width, height=height), 1)
    cameras = Cameras(
        world_from_camera=pose[None], fov_x=np.radians(45), width=width, height=height, center=(19.5, 20.0)
    )
    objects = tuple(DatasetObject(name=item.name, is_glass=item.material.is_glass) for item in scene.objects)
    return write_head(root, config, objects, dict.fromkeys(SPLITS, cameras), scene_files(scene))


def noisy(net: nn.Module, scales: dict[str, float] | None = None) -> None:
    """Puts noise into all weights and texels: a wrong one shows."""
    with torch.no_grad():
        for name, values in net.named_parameters():
            # The page sums all levels into one, which blurs the coarse one's noise; what is trained is smoother.
            scale = {"textures.0.table": 0.7, "textures.1.table": 0.15, **(scales or {})}.get(name, 0.35)
            values.copy_(torch.randn_like(values) * scale)


def solid_surfaces() -> Scene:
    """The same, floor and pane as slabs, so that each object has smaller copies within it, as proxies have."""
    slabs = {
        "floor": placed(trimesh.creation.box((4, 4, 0.2)), 0, 0, -0.1),
        "pane": placed(trimesh.creation.box((1.2, 0.1, 1.2)), 0, -0.7, 0.7),
    }
    objects = tuple(dataclasses.replace(item, mesh=slabs.get(item.name, item.mesh)) for item in every_surface().objects)
    return dataclasses.replace(every_surface(), objects=objects)


def darken(net: LightPathRenderer, texture: int) -> None:
    """Makes an object shine little by itself, so that one sees what it mirrors."""
    finest = net.textures.levels()[0] if isinstance(net.textures, TexturePyramid) else net.textures
    first, size = finest.layout.bases[texture], finest.layout.sizes[texture]
    finest.table[first : first + size * size, :3] -= 4


def noisy_light_path(**change: Any) -> LightPathRenderer:
    torch.manual_seed(3)
    parts = {
        "texture_sizes": (40, 8, 8, 8, 24, 17, 8),
        "texture_levels": 2,
        "hidden": 18,
        "stack_hidden": 10,
        "environment_size": 6,
        "sky_lobes": 3,
        "branches": 5,
        "render_samples": 1,
        "refined_samples": 1,
    }
    net = LightPathRenderer(LightPathConfig(**{**parts, **change}))
    noisy(net, {"relief.table": 4.0})
    with torch.no_grad():
        darken(net, METAL * net.config.shells)
        net.environment.maps[-1].fill_(-2.0)  # Else all would be white,
        if net.stack_net is not None:
            net.stack_net[-1].bias[:3].fill_(2.0)  # and what the stack adds too dark to be seen.
    return net.eval()


def drawn_by_python(
    renderer: LightPathRenderer,
    dataset: Dataset,
    samples: int = 1,
    objects: tuple[SceneObject, ...] | None = None,
) -> np.ndarray:
    """The product's own picture, (h, w, 3), of the scene or of other objects."""
    config = dataclasses.replace(renderer.config, render_samples=samples)
    pixels = config.load(open_inputs(config, dataset, TRUTH), "interpolating", [0], with_images=False)
    if objects is not None:
        tints = tints_of(dataclasses.replace(every_surface(), objects=objects), own_uv=True)
        meshes, materials = (tuple(getattr(item, part) for item in objects) for part in ("mesh", "material"))
        tracer = LightPathTracer(meshes, materials, tints)
        pixels = dataclasses.replace(pixels, tracer=tracer)
    assert isinstance(pixels, LightPathPixels)
    return predict_pixels(renderer, pixels).reshape(*SHAPE, 3)


@contextlib.contextmanager
def opened_page(
    browser: "Browser",
    folder: Path,
    renderer: Any,
    dataset: Dataset,
    quality: str = "exact",
    config: Any = None,
    **window: int,
) -> Iterator[Watched]:
    """The page of a renderer in a browser."""
    from hyaline_web.page.export import scene_page

    file = folder / "page.html"
    data = scene_page(renderer, config or renderer.config, dataset, TRUTH, quality, label="noise", still=STILL)  # pyright: ignore
    file.write_bytes(data)
    with watched_page(browser, **window) as page:
        open_file(page, file)
        yield page


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(np.square((one.astype(float) - other) / 255).mean() + 1e-12))
