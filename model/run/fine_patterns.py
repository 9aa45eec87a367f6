"""Patterns of a scene that its neural textures cannot hold: they have less than two texels a period."""

import math

import numpy as np
from jaxtyping import Float
from torch import nn

from datagen.data.cameras import Cameras
from datagen.data.dataset import Dataset
from datagen.data.meshes import face_areas, is_there
from datagen.data.paths import TRUTH
from datagen.scene.description import SceneObject
from datagen.scene.folder import load_scene
from datagen.scene.textures import SolidTexture
from model.nets.texture import NeuralTextures

TEXELS = 2.0
"""A period that can be told from an even colour (Nyquist)."""
PIXELS = 2.0
"""Of a period that pictures show."""
MAX_NAMES = 6


def told_fine_patterns(dataset: Dataset, geometry: str, renderer: nn.Module) -> list[str]:
    """A line that names the patterns which training pictures show and the renderer's textures are too coarse for."""
    if geometry != TRUTH or dataset.imported is not None:
        return []
    widths = finest_widths(renderer, len(dataset.objects))
    if not widths:
        return []
    scene, cameras = load_scene(dataset.root / "scene", is_sealed=True), dataset.cameras("train")
    blurred, enough = [], 0
    for item, width in zip(scene.objects, widths, strict=True):
        if (texels := texels_of_period(item, width, cameras)) < TEXELS:
            blurred.append(f"{item.name} ({texels:.2g} texels)")
            enough = max(enough, math.ceil(width * TEXELS / texels))
    if not blurred:
        return []
    shown = ", ".join(blurred[:MAX_NAMES]) + (f" and {len(blurred) - MAX_NAMES} more" if blurred[MAX_NAMES:] else "")
    return [f"textures blur patterns with less than two texels a period: {shown}; {enough} texels across hold them all"]


def finest_widths(renderer: nn.Module, num_objects: int) -> list[int]:
    """Texels across each object's widest texture; none where the renderer has no textures of objects."""
    found = []
    for module in renderer.modules():
        sizes = module.layout.sizes if isinstance(module, NeuralTextures) else ()
        # Some have textures for several copies of each object, one after the other and all of one size.
        if sizes and len(sizes) % num_objects == 0:
            found.append(sizes[:: len(sizes) // num_objects])
    return np.max(found, axis=0).tolist() if found else []


def texels_of_period(item: SceneObject, width: int, cameras: Cameras) -> float:
    """Texels a period of an object's pattern in a texture of so many across; infinite where nobody would miss them."""
    pattern = next((value for value in vars(item.material).values() if isinstance(value, SolidTexture)), None)
    if pattern is None or not is_there(item.mesh):
        return math.inf
    places = cameras.world_from_camera[:, :3, 3]
    distance = np.median([np.linalg.norm(item.mesh.vertices - place, axis=-1).min() for place in places])
    if pattern.scale * cameras.focal < PIXELS * distance:
        return math.inf
    across = float(np.sqrt(_uv_areas(item).sum() / face_areas(item.mesh).sum()))  # Of the atlas, by metre.
    return pattern.scale * width * across or math.inf


def _uv_areas(item: SceneObject) -> Float[np.ndarray, " face"]:
    a, b, c = np.moveaxis(item.mesh.uv[item.mesh.faces].astype(np.float64), 1, 0)
    return 0.5 * np.abs(np.linalg.det(np.stack([b - a, c - a], axis=-1)))
