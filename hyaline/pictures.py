"""Pictures that notebooks show, of scenes, datasets, views, proxies and runs."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import Dataset, View, has_layers
from datagen.data.geometries import read_meshes
from datagen.data.meshes import Mesh, is_there
from datagen.data.paths import TRUTH
from datagen.disk.checked import checked
from datagen.scene.soundness import camera_places
from hyaline.proxies import Proxies
from hyaline.runs import Run
from hyaline.scenes import Scene

HEIGHT = 256
"""Pixels of a picture in a notebook: small ones are enlarged without smoothing."""
GAP = 4
SKETCH = (640, 480)
AROUND = 0.35
"""Room around the glass in a sketch, as a share of its size."""


@checked
def show(item: Scene | Dataset | View | Proxies | Run) -> Image.Image:
    """A picture of a scene, dataset, view, proxies or run, which notebooks show.

    >>> from hyaline import open_dataset
    >>> show(open_dataset("glass_table").view("train", 0)).height     # the picture, glass, depth, normals, each layer
    256

    A scene and proxies are sketched as by a pen, with clear glass; a dataset shows the first view of each split, a run
    that of each test split: the truth, and beside it what the run predicts.
    """
    if isinstance(item, Scene):
        return _in_a_row([_scene_sketch(item)])
    if isinstance(item, Dataset):
        return _in_a_row([item.view(split, 0).image for split in item.splits])
    if isinstance(item, View):
        from datagen.look.view_pictures import stored_pictures

        stored = stored_pictures(item, has_layers=has_layers(item.dataset))
        return _in_a_row([picture.pixels for picture in stored.values()])
    if isinstance(item, Proxies):
        from datagen.look.sketch import open_azimuth_deg

        is_glass, azimuth_deg = [one.is_glass for one in item.dataset.objects], open_azimuth_deg(item.dataset)
        both = (read_meshes(item.dataset, TRUTH), item.meshes)
        return _in_a_row([_sketch(meshes, is_glass, azimuth_deg) for meshes in both])
    views = [item.dataset.view(split, 0) for split in TEST_SPLITS]
    return _in_a_row([picture for view in views for picture in (view.image, item.prediction(view))])


def _scene_sketch(scene: Scene) -> UInt8[np.ndarray, "h w 3"]:
    """A scene from the side of its cameras."""
    objects, rig = scene.sketched()
    offset = camera_places(rig).mean(axis=0) - np.array(rig.target)
    is_around = np.hypot(offset[0], offset[1]) < 0.1 * rig.radius
    azimuth_deg = -60.0 if is_around else math.degrees(math.atan2(offset[1], offset[0]))
    return _sketch([one.mesh for one in objects], [one.material.is_glass for one in objects], azimuth_deg)


def _in_a_row(pictures: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> Image.Image:
    """Pictures of one height side by side, on white."""
    height = len(pictures[0])
    white = np.full((height, max(1, GAP * height // HEIGHT), 3), 255, np.uint8)
    parts = [part for picture in pictures for part in (picture, white)][:-1]
    row = Image.fromarray(np.hstack(parts))
    scale = max(1, HEIGHT // height)
    return row.resize((scale * row.width, scale * row.height), Image.Resampling.NEAREST)


def _sketch(meshes: Sequence[Mesh], is_glass: Sequence[bool], azimuth_deg: float) -> UInt8[np.ndarray, "h w 3"]:
    """Meshes as a pen would draw them, around the glass; around all of them where there is none.

    Args:
        azimuth_deg: side of the scene from which they are seen, from +x towards +y.
    """
    from datagen.look.sketch import draw_sketch, fit_viewpoint

    there = [mesh for mesh in meshes if is_there(mesh)]
    subject = [mesh for mesh, glass in zip(meshes, is_glass, strict=True) if glass and is_there(mesh)] or there
    corners = np.concatenate([mesh.vertices for mesh in subject]).astype(np.float64)
    low, high = corners.min(axis=0), corners.max(axis=0)
    room = AROUND * (high - low).max()
    around = np.stack(np.meshgrid(*np.stack([low - room, high + room], axis=-1)), axis=-1).reshape(-1, 3)
    width, height = SKETCH
    viewpoint = fit_viewpoint(around, azimuth_deg, 20.0, width=width, height=height)
    glass: Bool[np.ndarray, " mesh"] = np.array(is_glass, bool)
    drawn = draw_sketch(tuple(meshes), glass, viewpoint).picture.astype(np.float64)
    alpha = drawn[..., 3:] / 255
    return (alpha * drawn[..., :3] + (1 - alpha) * 255).astype(np.uint8)
