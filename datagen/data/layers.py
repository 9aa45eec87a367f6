"""Straight layers: every surface along a pixel's ray, in memory and on disk (format around them: layer_store.py).

    LAYERS/peels.zarr/SPLIT/uv           (view, 2, layer, h, w) uint16: u, v times 65535, rounded
    LAYERS/peels.zarr/SPLIT/object_id    (view, layer, h, w) uint8: 0 = empty
    LAYERS/peels.zarr/SPLIT/depth        (view, layer, h, w) float32: metres along the ray, 0 where empty

LAYERS is layers/straight of a geometry. One chunk a plane. uv is never filtered or resized: neighbours across a seam do
not mix. Depth keeps 16 of its 23 mantissa bits (relative error 8e-6), which compresses to two thirds.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16

from datagen.data.config import Split
from datagen.data.layer_store import LayerStore


@dataclass(frozen=True, kw_only=True, eq=False)
class Layers:
    """The surfaces along each pixel's ray, nearest first; empty layers come only after hits."""

    uv: UInt16[np.ndarray, "layer h w 2"]
    """Atlas coordinates times 65535; (0, 0) where empty."""
    object_id: UInt8[np.ndarray, "layer h w"]
    depth: Float32[np.ndarray, "layer h w"]
    """Distance from the camera's centre along the unit ray in metres; 0 where empty."""


def read_layers(store: LayerStore, split: Split, view: int) -> Layers:
    """One view's layers, every byte verified."""
    arrays = store.read(split, view)
    return Layers(uv=np.moveaxis(arrays["uv"], 0, -1), object_id=arrays["object_id"], depth=arrays["depth"])


def glass_mask(object_id: UInt8[np.ndarray, "layer h w"], is_glass: Bool[np.ndarray, " id"]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose centre ray meets glass before anything opaque.

    Args:
        is_glass: by object id; that of 0, where there is nothing, is False.
    """
    in_front = np.ones(object_id.shape[1:], bool)
    sees_glass = np.zeros_like(in_front)
    for ids in object_id:
        in_front &= is_glass[ids]
        sees_glass |= in_front
    return sees_glass
