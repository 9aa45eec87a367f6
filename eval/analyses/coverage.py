"""How well training views cover the surface points on test rays: angle, and number of views."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.layers import Layers

MAX_GRID = 32
"""Texels here are 32 x 32 cells of an object's atlas, fewer for pictures narrower than 128 pixels: coarse enough that
training views leave no holes (7 of their rays hit each texel that they see)."""

MAX_PIXELS = 128 * 128
"""Pixels analysed per view; from more, a fixed random choice."""

CHUNK = 1 << 10
"""Rays compared with all training cameras at once: few enough for the results to stay in the processor's cache."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Coverage:
    """The training views that saw each texel in each layer, in layers x objects x grid^2 x views / 8 bytes.

    That is 1.9 MB for 18 objects and 100 views, and at most 261 MB for 255 objects and 1,000 views (8 layers).
    """

    seen: UInt8[np.ndarray, "texel eighth"]
    """A bit per training view: set if one of its pixel-centre rays hits the texel in this layer."""
    p_camera: Float[np.ndarray, "view 3"]
    """Centres of the training cameras in metres."""
    is_glass: Bool[np.ndarray, " object"]
    """By object id; False for 0, which means empty."""
    grid: int
    """Cells along each side of an atlas."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelCoverage:
    """The training coverage of some pixels of a test view; pixels without a surface are left out."""

    pixel: Int[np.ndarray, " pixel"]
    """Index in the picture, row by row."""
    angle_deg: Float[np.ndarray, " pixel"]
    """Angle to the nearest training ray in degrees; inf if no training ray saw one of the pixel's texels."""
    views: Int[np.ndarray, " pixel"]
    """Training views that saw the pixel's texel, in its least seen layer."""


def visible_layers(layers: Layers, is_glass: Bool[np.ndarray, " object"]) -> Bool[np.ndarray, "layer h w"]:
    """The layers that light reaches the pixel from: the first opaque one, and all glass before it."""
    is_open = np.cumprod(is_glass[layers.object_id], axis=0, dtype=bool)
    before = np.concatenate([np.ones_like(is_open[:1]), is_open[:-1]])
    return before & (layers.object_id > 0)


def read_coverage(dataset: Dataset) -> Coverage:
    """The coverage by the dataset's training views, from their stored straight layers of the true geometry.

    All views of the training split count, including the few that a method holds out.
    """
    is_glass = np.array([False, *(item.is_glass for item in dataset.objects)])
    num_views = dataset.config.train.views
    grid = min(MAX_GRID, max(1, dataset.config.resolution.mean_side // 4))
    seen: np.ndarray | None = None
    for view in range(num_views):
        layers = dataset.view("train", view).layers()
        if seen is None:
            texels = len(layers.object_id) * len(dataset.objects) * grid**2
            seen = np.zeros((texels, (num_views + 7) // 8), np.uint8)
        texel = np.unique(_texels(layers, len(dataset.objects), grid)[visible_layers(layers, is_glass)])
        seen[texel, view // 8] |= np.uint8(1 << (view % 8))
    assert seen is not None
    p_camera = dataset.cameras("train").world_from_camera[:, :3, 3]
    return Coverage(seen=seen, p_camera=p_camera, is_glass=is_glass, grid=grid)


def cover_view(coverage: Coverage, dataset: Dataset, split: Split, view: int) -> PixelCoverage:
    """The training coverage of one test view.

    The angle of a layer is measured where the test ray hits it, between that ray and the line to the nearest training
    camera that saw the point's texel in the same layer. So directions are exact, and the texel only decides which
    cameras count. The angle of a pixel is the largest one of its visible layers: each contributes to the colour, and
    the least known one limits it. Measured on the glass table at 128 pixels with `paper`, the rank correlation of
    squared error and angle is 0.40 with the largest, 0.37 with the mean, 0.31 with the opaque layer's.
    """
    layers = dataset.view(split, view).layers()
    size = layers.object_id.shape[1] * layers.object_id.shape[2]
    visible = visible_layers(layers, coverage.is_glass).reshape(-1, size)
    pixel = np.flatnonzero(visible[0])
    if len(pixel) > MAX_PIXELS:
        pixel = np.sort(np.random.default_rng(view).choice(pixel, MAX_PIXELS, replace=False))
    layer, place = np.nonzero(visible[:, pixel])
    texel = _texels(layers, len(coverage.is_glass) - 1, coverage.grid).reshape(-1, size)[layer, pixel[place]]
    origin, directions = dataset.cameras(split)[view].rays()
    rays = directions.reshape(-1, 3)[pixel[place]].astype(np.float64)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)  # In float32, the cosine of a small angle would be lost.
    points = origin + layers.depth.reshape(-1, size)[layer, pixel[place], None] * rays

    angle, views = np.zeros(len(pixel)), np.full(len(pixel), len(coverage.p_camera))
    for start in range(0, len(rays), CHUNK):
        part = slice(start, start + CHUNK)
        is_seen = np.unpackbits(
            coverage.seen[texel[part]], axis=1, count=len(coverage.p_camera), bitorder="little"
        ).astype(bool)
        np.maximum.at(angle, place[part], _nearest_angle(points[part], rays[part], coverage.p_camera, is_seen))
        np.minimum.at(views, place[part], is_seen.sum(axis=1))
    return PixelCoverage(pixel=pixel, angle_deg=np.degrees(angle), views=views)


def _nearest_angle(
    points: Float[np.ndarray, "ray 3"],
    rays: Float[np.ndarray, "ray 3"],
    p_camera: Float[np.ndarray, "view 3"],
    is_seen: Bool[np.ndarray, "ray view"],
) -> Float[np.ndarray, " ray"]:
    """The smallest angle in radians at a point between its ray and the lines to the cameras that saw it, or inf."""
    # |p - c|^2 and (p - c) . d without an array of (ray, view, 3).
    squared = np.sum(points**2, axis=1)[:, None] - 2 * points @ p_camera.T + np.sum(p_camera**2, axis=1)
    along = np.sum(points * rays, axis=1)[:, None] - rays @ p_camera.T
    cosine = np.where(is_seen, along / np.sqrt(np.maximum(squared, 1e-18)), -np.inf).max(axis=1)
    return np.where(cosine == -np.inf, np.inf, np.arccos(np.clip(cosine, -1, 1)))


def _texels(layers: Layers, num_objects: int, grid: int) -> Int[np.ndarray, "layer h w"]:
    """The index of the texel in its layer; meaningless where the layer is empty."""
    cell = np.minimum(layers.uv.astype(np.int64) * grid // 65535, grid - 1)
    layer = np.arange(len(layers.object_id))[:, None, None]
    item = layers.object_id.astype(np.int64) - 1
    return ((layer * num_objects + item) * grid + cell[..., 1]) * grid + cell[..., 0]
