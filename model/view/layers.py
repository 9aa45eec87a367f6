"""Straight layers as any camera sees them: one layer at a time, each object in a colour of its own."""

import numpy as np
from jaxtyping import UInt8

from datagen.data.cameras import Camera
from datagen.data.dataset import Dataset
from datagen.look.view_pictures import object_colors
from model.batches.traced_layers import peel_cameras

CHECKS = 24
"""Squares that a texture is wide, lighter and darker in turn: they show how uv runs over a surface."""


def draw_layer(
    dataset: Dataset, geometry: str, camera: Camera, layer: int, num_layers: int
) -> UInt8[np.ndarray, "h w 3"]:
    """The surfaces of one layer along the rays of a camera, layer 0 the nearest."""
    pixels = peel_cameras(dataset, geometry, num_layers, camera.alone)
    ids = pixels.object_id[:, layer].numpy()
    uv = pixels.uv[:, layer].numpy().view(np.uint16)
    is_light = (uv.astype(np.int64) * CHECKS // 65536).sum(axis=-1) % 2 == 0
    colors = object_colors(len(dataset.objects))[ids]
    checked = np.where((is_light | (ids == 0))[:, None], colors, (0.8 * colors).astype(np.uint8))
    return checked.reshape(camera.height, camera.width, 3)
