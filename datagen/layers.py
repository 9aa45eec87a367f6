"""Owns peeled layers: the record in memory and its zarr store on disk.

    LAYERS/layers.json                   sealed: version, kind, geometry, num_layers, SHA-256 of the store's metadata
    LAYERS/peels.zarr/SPLIT/uv           (view, 2, layer, h, w) uint16: u, v times 65535, rounded
    LAYERS/peels.zarr/SPLIT/object_id    (view, layer, h, w) uint8: 0 = empty
    LAYERS/peels.zarr/SPLIT/depth        (view, layer, h, w) float32: metres along the ray, 0 where empty
    LAYERS/records/SPLIT/0000.json       sealed, written last: SHA-256 of the view's three shards

One shard a view and array, one chunk a plane, blosc zstd-5 with byte shuffle: standard zarr v3 codecs only. uv is never
filtered or resized: neighbours across a seam do not mix. Depth keeps 16 of its 23 mantissa bits (relative error 8e-6),
which compresses to two thirds.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16

from datagen.dataset import SPLITS, Dataset, Split, check_files, view_name
from datagen.errors import HyalineError
from datagen.geometry import geometry_root
from datagen.records import Json, from_json, to_json
from datagen.storage import SEAL, commit_sealed, load_json, load_sealed, sha256_file

LAYERS_VERSION = 1
UV_SCALE = 65535
ARRAYS = ("uv", "object_id", "depth")

LayerKind = Literal["straight"]
LAYER_KINDS: tuple[LayerKind, ...] = ("straight",)


@dataclass(frozen=True, kw_only=True, eq=False)
class Layers:
    """The surfaces along each pixel's ray, nearest first; empty layers come only after hits."""

    uv: UInt16[np.ndarray, "layer h w 2"]
    """Atlas coordinates times 65535; (0, 0) where empty."""
    object_id: UInt8[np.ndarray, "layer h w"]
    depth: Float32[np.ndarray, "layer h w"]
    """Distance from the camera's centre along the unit ray in metres; 0 where empty."""


@dataclass(frozen=True, kw_only=True)
class LayersHead:
    """What a store of layers holds."""

    version: int
    kind: LayerKind
    geometry: str
    """Hash over the meshes that were peeled."""
    num_layers: int
    files: dict[str, str]
    """SHA-256 of the zarr metadata, by path relative to the store."""


@dataclass(frozen=True, kw_only=True)
class LayersRecord:
    """One peeled view."""

    layers: str
    """The seal of the store's head."""
    split: Split
    view: int
    overflow_share: float
    """Share of the rays that had more hits than layers."""
    files: dict[str, str]


def layers_root(root: Path, geometry: str, kind: LayerKind) -> Path:
    return geometry_root(root, geometry) / "layers" / kind


def create_store(dataset: Dataset, geometry: str, kind: LayerKind, *, num_layers: int, geometry_hash: str) -> None:
    """Lays out an empty store: zarr metadata first, the head last."""
    import zarr
    from zarr.codecs import BloscCodec

    root = layers_root(dataset.root, geometry, kind)
    size = dataset.config.resolution
    compressor = BloscCodec(cname="zstd", clevel=5, shuffle="shuffle")
    store = zarr.open_group(root / "peels.zarr", mode="w", zarr_format=3)
    for split in SPLITS:
        views = dataset.config.split(split).views
        group = store.create_group(split)
        planes = {"uv": (2, num_layers), "object_id": (num_layers,), "depth": (num_layers,)}
        for name, dtype in zip(ARRAYS, ("uint16", "uint8", "float32"), strict=True):
            names = ("view", "uv", "layer", "y", "x") if name == "uv" else ("view", "layer", "y", "x")
            group.create_array(
                name,
                shape=(views, *planes[name], size, size),
                chunks=(1, *(1 for _ in planes[name]), size, size),
                shards=(1, *planes[name], size, size),
                dtype=dtype,
                compressors=compressor,
                dimension_names=names,
            )
    metadata = sorted((root / "peels.zarr").rglob("zarr.json"))
    head = LayersHead(
        version=LAYERS_VERSION,
        kind=kind,
        geometry=geometry_hash,
        num_layers=num_layers,
        files={path.relative_to(root).as_posix(): sha256_file(path) for path in metadata},
    )
    commit_sealed(root / "layers.json", cast(dict[str, Json], to_json(head)))


def read_layers_head(dataset: Dataset, geometry: str, kind: LayerKind) -> tuple[LayersHead, str]:
    """The head of a store and its seal.

    Raises:
        HyalineError: the geometry was not peeled, or the head is damaged.
    """
    path = layers_root(dataset.root, geometry, kind) / "layers.json"
    if not path.is_file():
        raise HyalineError(
            f"{path}: {geometry} has no {kind} layers; make them with "
            f"`datagen peel --dataset {dataset.root} --geometry {geometry}`"
        )
    content = load_sealed(path)
    if content.get("version") != LAYERS_VERSION:
        raise HyalineError(f"{path}: format version {content.get('version')!r}; this program reads {LAYERS_VERSION}")
    return from_json(LayersHead, cast(Json, content), where=str(path)), cast(str, load_json(path)[SEAL])


def write_layers(dataset: Dataset, geometry: str, kind: LayerKind, split: Split, view: int, layers: Layers,
                 *, overflow_share: float) -> None:  # fmt: skip
    """Commits one view's layers: three shards, then the record."""
    import zarr

    root = layers_root(dataset.root, geometry, kind)
    _, seal = read_layers_head(dataset, geometry, kind)
    group = zarr.open_group(root / "peels.zarr" / split, mode="r+")
    values = {"uv": np.moveaxis(layers.uv, -1, 0), "object_id": layers.object_id, "depth": round_depth(layers.depth)}
    files = {}
    for name in ARRAYS:
        # Chunks of zeros are left out of a shard. A shard of nothing else must still be there, or no record could
        # promise it. zarr 3.1 keeps the option in the array as it is opened, not in the store.
        with zarr.config.set({"array.write_empty_chunks": not values[name].any()}):
            array = cast(zarr.Array, group[name])
        array[view] = values[name]
        path = _shard_path(root, split, name, view)
        files[path.relative_to(root).as_posix()] = sha256_file(path)
    record = LayersRecord(layers=seal, split=split, view=view, overflow_share=overflow_share, files=files)
    commit_sealed(record_path_of_layers(root, split, view), cast(dict[str, Json], to_json(record)))


def read_layers_record(dataset: Dataset, geometry: str, kind: LayerKind, split: Split, view: int) -> LayersRecord:
    """The record of one peeled view.

    Raises:
        HyalineError: not peeled, damaged, or of another store.
    """
    root = layers_root(dataset.root, geometry, kind)
    _, seal = read_layers_head(dataset, geometry, kind)
    path = record_path_of_layers(root, split, view)
    if not path.is_file():
        raise HyalineError(
            f"{path}: the view is not peeled yet; finish with "
            f"`datagen peel --dataset {dataset.root} --geometry {geometry}`"
        )
    record = from_json(LayersRecord, cast(Json, load_sealed(path)), where=str(path))
    if (record.layers, record.split, record.view) != (seal, split, view):
        raise HyalineError(f"{path}: belongs to {record.split} view {record.view} of other layers; peel it again")
    return record


def read_layers(dataset: Dataset, geometry: str, kind: LayerKind, split: Split, view: int) -> Layers:
    """One view's layers, every byte verified."""
    import zarr

    root = layers_root(dataset.root, geometry, kind)
    head, _ = read_layers_head(dataset, geometry, kind)
    metadata = {key: value for key, value in head.files.items() if f"/{split}/" in key}
    check_files(root, metadata | read_layers_record(dataset, geometry, kind, split, view).files)
    group = zarr.open_group(root / "peels.zarr" / split, mode="r")
    arrays = {name: np.asarray(cast(zarr.Array, group[name])[view]) for name in ARRAYS}
    return Layers(uv=np.moveaxis(arrays["uv"], 0, -1), object_id=arrays["object_id"], depth=arrays["depth"])


def is_view_peeled(dataset: Dataset, geometry: str, kind: LayerKind, split: Split, view: int) -> bool:
    """True when the view's record and shards verify."""
    try:
        files = read_layers_record(dataset, geometry, kind, split, view).files
        check_files(layers_root(dataset.root, geometry, kind), files)
    except HyalineError:
        return False
    return True


def quantize_uv(uv: Float32[np.ndarray, "layer h w 2"]) -> UInt16[np.ndarray, "layer h w 2"]:
    """16-bit uv; the error is at most 7.6e-6, 0.03 of a texel even at 4096 texels."""
    return np.rint(np.clip(uv.astype(np.float64), 0, 1) * UV_SCALE).astype(np.uint16)


def round_depth(depth: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Depth with 16 mantissa bits, rounded to nearest; what is stored."""
    bits = np.ascontiguousarray(depth, np.float32).view(np.uint32)
    return ((bits + np.uint32(0x40)) & np.uint32(0xFFFFFF80)).view(np.float32)


def glass_mask(dataset: Dataset, layers: Layers) -> Bool[np.ndarray, "h w"]:
    """Pixels whose centre ray meets glass before anything opaque."""
    is_glass = np.array([False, *(item.is_glass for item in dataset.objects)])
    in_front = np.ones(layers.object_id.shape[1:], bool)
    sees_glass = np.zeros_like(in_front)
    for object_id in layers.object_id:
        in_front &= is_glass[object_id]
        sees_glass |= in_front
    return sees_glass


def _shard_path(root: Path, split: Split, name: str, view: int) -> Path:
    zeros = ("0",) * (4 if name == "uv" else 3)
    return root.joinpath("peels.zarr", split, name, "c", str(view), *zeros)


def record_path_of_layers(root: Path, split: Split, view: int) -> Path:
    return root / "records" / split / f"{view_name(view)}.json"
