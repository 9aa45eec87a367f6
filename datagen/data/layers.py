"""Owns straight layers: the record in memory, and its arrays on disk (beside them: datagen/data/layer_store.py).

    LAYERS/peels.zarr/SPLIT/uv           (view, 2, layer, h, w) uint16: u, v times 65535, rounded
    LAYERS/peels.zarr/SPLIT/object_id    (view, layer, h, w) uint8: 0 = empty
    LAYERS/peels.zarr/SPLIT/depth        (view, layer, h, w) float32: metres along the ray, 0 where empty

LAYERS is layers/straight of a geometry. One chunk a plane. uv is never filtered or resized: neighbours across a seam do
not mix. Depth keeps 16 of its 23 mantissa bits (relative error 8e-6), which compresses to two thirds.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.layer_store import LAYERS_VERSION, ArrayFormat, LayersHead, create_store, read_view, write_view
from datagen.data.number_formats import round_mantissa


@dataclass(frozen=True, kw_only=True, eq=False)
class Layers:
    """The surfaces along each pixel's ray, nearest first; empty layers come only after hits."""

    uv: UInt16[np.ndarray, "layer h w 2"]
    """Atlas coordinates times 65535; (0, 0) where empty."""
    object_id: UInt8[np.ndarray, "layer h w"]
    depth: Float32[np.ndarray, "layer h w"]
    """Distance from the camera's centre along the unit ray in metres; 0 where empty."""


def create_layers(dataset: Dataset, geometry: str, *, num_layers: int, geometry_hash: str,
                  replace: bool = False) -> None:  # fmt: skip
    """Lays out an empty store."""
    size = dataset.config.resolution
    plane = ArrayFormat(dtype="uint8", axes=("layer", "y", "x"), shape=(num_layers, size, size), chunk=(1, size, size))
    arrays = {
        "uv": ArrayFormat(dtype="uint16", axes=("uv", *plane.axes), shape=(2, *plane.shape), chunk=(1, *plane.chunk)),
        "object_id": plane,
        "depth": dataclasses.replace(plane, dtype="float32"),
    }
    head = LayersHead(version=LAYERS_VERSION, kind="straight", geometry=geometry_hash, num_layers=num_layers, files={})
    create_store(dataset, geometry, head, arrays, replace=replace)


def write_layers(dataset: Dataset, geometry: str, split: Split, view: int, layers: Layers,
                 *, overflow_share: float) -> None:  # fmt: skip
    """Commits one view's layers."""
    values = {
        "uv": np.moveaxis(layers.uv, -1, 0),
        "object_id": layers.object_id,
        "depth": round_mantissa(layers.depth),
    }
    write_view(dataset, geometry, "straight", split, view, values, overflow_share=overflow_share)


def read_layers(dataset: Dataset, geometry: str, split: Split, view: int) -> Layers:
    """One view's layers, every byte verified."""
    arrays = read_view(dataset, geometry, "straight", split, view)
    return Layers(uv=np.moveaxis(arrays["uv"], 0, -1), object_id=arrays["object_id"], depth=arrays["depth"])


def read_object_ids(dataset: Dataset, geometry: str, split: Split, view: int) -> UInt8[np.ndarray, "layer h w"]:
    """The object ids of one view's layers alone, verified: a small part of what `read_layers` reads."""
    return read_view(dataset, geometry, "straight", split, view, only=["object_id"])["object_id"]


def read_uv_and_ids(dataset: Dataset, geometry: str, split: Split, view: int
                    ) -> tuple[UInt16[np.ndarray, "layer h w 2"], UInt8[np.ndarray, "layer h w"]]:  # fmt: skip
    """uv and object ids of one view's layers, verified: all that `read_layers` reads but depth, in two thirds of the
    time."""
    arrays = read_view(dataset, geometry, "straight", split, view, only=["uv", "object_id"])
    return np.moveaxis(arrays["uv"], 0, -1), arrays["object_id"]


def glass_mask(dataset: Dataset, layers: Layers) -> Bool[np.ndarray, "h w"]:
    """Pixels whose centre ray meets glass before anything opaque."""
    is_glass = np.array([False, *(item.is_glass for item in dataset.objects)])
    in_front = np.ones(layers.object_id.shape[1:], bool)
    sees_glass = np.zeros_like(in_front)
    for object_id in layers.object_id:
        in_front &= is_glass[object_id]
        sees_glass |= in_front
    return sees_glass
