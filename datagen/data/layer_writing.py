"""Writing layers: an empty store, then view by view."""

import dataclasses
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.layer_store import (
    LAYERS_VERSION,
    STORE,
    LayersHead,
    LayersRecord,
    open_layers,
    record_path_of_layers,
)
from datagen.data.layers import Layers, round_mantissa
from datagen.data.paths import layers_root
from datagen.disk.errors import DamagedError, HyalineError
from datagen.disk.heads import keep_head
from datagen.disk.names import check_relative
from datagen.disk.os_errors import naming
from datagen.disk.ownership import LAYERS, begin, is_ours
from datagen.disk.promises import check_files
from datagen.disk.records import Json, from_json, to_json
from datagen.disk.storage import commit_same, commit_sealed, load_sealed, seal_bytes, seal_of, sha256, sha256_file


@dataclass(frozen=True, kw_only=True)
class ArrayFormat:
    """What an array holds for each view."""

    dtype: str
    axes: tuple[str, ...]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    """Shape of the pieces that are compressed one by one."""


def _create_store(
    dataset: Dataset, geometry: str, head: LayersHead, arrays: Mapping[str, ArrayFormat], *, replace: bool = False
) -> None:
    """Commits the head of a store (whose `files` are filled in), then zarr's metadata: an empty store.

    Several processes may do the same at once: the bytes are the same, and no view that is there is touched. Of a store
    that stands there, metadata that is missing or damaged is written again.

    Args:
        replace: take the place of a head that stands there; views that verify under the new one are kept.

    Raises:
        DamagedError: metadata that stands there is damaged, and this version of zarr writes other bytes.
        HyalineError: something else stands there.
    """
    root = layers_root(dataset.root, geometry)
    stands = not replace and is_ours(root, LAYERS)
    promised = open_layers(dataset.root, geometry).head.files if stands else {}
    if stands and _are_good(root, promised):
        keep_head(dataset.root, root / "layers.json")
        return
    metadata = _store_metadata(dataset, arrays)
    files = {path: sha256(data) for path, data in metadata.items()}
    content = cast(dict[str, Json], to_json(dataclasses.replace(head, files=files)))
    if replace and is_ours(root, LAYERS):
        commit_sealed(root / LAYERS.head, content)
    elif not stands:
        begin(root, LAYERS, seal_bytes(content), metadata, is_proven=lambda: _has_record_of(root, seal_of(content)))
    for path, data in metadata.items():
        if not stands or promised.get(path) == files[path]:
            commit_same(root / path, data)
    if stands:
        check_files(root, promised)
    keep_head(dataset.root, root / LAYERS.head)


def _has_record_of(root: Path, seal: str) -> bool:
    """True when a view there was peeled under the head of this seal, which may have been lost since."""
    return any(_record(path).get("layers") == seal for path in root.glob("records/*/*.json"))


def _record(path: Path) -> dict[str, Json]:
    """The content of a view's record; empty when it is none, or damaged."""
    try:
        content = load_sealed(path)
    except HyalineError:
        return {}
    return content if "layers" in content else {}


def layers_files(root: Path) -> list[str]:
    """What stands in a folder of layers besides its head, by path relative to it, records first.

    Pieces of arrays go by zarr's names for them, since one that was being written stands in no record yet.
    """
    path = root / LAYERS.head
    files = from_json(dict[str, str], load_sealed(path).get("files"), where=f"{path}: files")
    metadata = [check_relative(file, where=f"{path}: files") for file in files]
    records = [found for found in sorted(root.glob("records/*/*.json")) if _record(found)]
    arrays = [(root / file).parent for file in metadata if len(Path(file).parts) == 4]
    pieces = [
        piece
        for array in arrays
        for piece in sorted(array.glob("c/**/*"))
        if all(part.isdecimal() for part in piece.relative_to(array / "c").parts) and piece.is_file()
    ]
    return [*(found.relative_to(root).as_posix() for found in (*records, *pieces)), *metadata]


def _are_good(root: Path, files: Mapping[str, str]) -> bool:
    try:
        check_files(root, dict(files))
    except DamagedError:
        return False
    return True


def _store_metadata(dataset: Dataset, arrays: Mapping[str, ArrayFormat]) -> dict[str, bytes]:
    """What zarr writes for an empty store, by path relative to LAYERS."""
    import zarr
    from zarr.codecs import BloscCodec

    compressor = BloscCodec(cname="zstd", clevel=5, shuffle="shuffle")
    with tempfile.TemporaryDirectory() as folder:
        store = zarr.open_group(Path(folder) / STORE, mode="w", zarr_format=3)
        for split in dataset.splits:
            views = dataset.config.split(split).views
            group = store.create_group(split)
            for name, array in arrays.items():
                group.create_array(
                    name,
                    shape=(views, *array.shape),
                    chunks=(1, *array.chunk),
                    shards=(1, *array.shape),
                    dtype=array.dtype,
                    compressors=compressor,
                    dimension_names=("view", *array.axes),
                )
        found = sorted(Path(folder).rglob("zarr.json"))
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def check_settings(*, num_layers: int, workers: int) -> None:
    """Refuses how layers cannot be made, before anything is done.

    Raises:
        HyalineError: naming the number.
    """
    if not 1 <= num_layers <= 255:
        raise HyalineError(f"num_layers: is {num_layers}; expected 1 to 255")
    if workers < 1:
        raise HyalineError(f"workers: is {workers}; expected at least 1")


def write_layers(
    dataset: Dataset, geometry: str, split: Split, view: int, layers: Layers, *, overflow_share: float
) -> None:
    """Commits one view's layers: their shards, then the record."""
    import zarr

    values = {
        "uv": np.moveaxis(layers.uv, -1, 0),
        "object_id": layers.object_id,
        "depth": round_mantissa(layers.depth),
    }
    store = dataset.layer_store(geometry)
    root = store.root
    with naming(root / STORE / split):
        group = zarr.open_group(root / STORE / split, mode="r+")
    record_path = record_path_of_layers(root, split, view)
    record_path.unlink(missing_ok=True)  # A view that is made again stops to exist first.
    files = {}
    for name, value in values.items():
        # Chunks of zeros are left out of a shard. A shard of nothing else must still be there, or no record could
        # promise it. zarr 3.1 keeps the option in the array as it is opened, not in the store.
        with zarr.config.set({"array.write_empty_chunks": not value.any()}):
            array = cast(zarr.Array, group[name])
        path = root.joinpath(STORE, split, name, "c", str(view), *("0",) * (array.ndim - 1))
        # zarr 3.1 reads the shard that it is about to replace, and fails where that is damaged.
        path.unlink(missing_ok=True)
        with naming(path):
            array[view] = value
        files[path.relative_to(root).as_posix()] = sha256_file(path)
    record = LayersRecord(layers=store.seal, split=split, view=view, overflow_share=overflow_share, files=files)
    commit_sealed(record_path, cast(dict[str, Json], to_json(record)))


def create_layers(
    dataset: Dataset, geometry: str, *, num_layers: int, geometry_hash: str, replace: bool = False
) -> None:
    """Lays out an empty store."""
    size = dataset.config.resolution.shape
    plane = ArrayFormat(dtype="uint8", axes=("layer", "y", "x"), shape=(num_layers, *size), chunk=(1, *size))
    arrays = {
        "uv": ArrayFormat(dtype="uint16", axes=("uv", *plane.axes), shape=(2, *plane.shape), chunk=(1, *plane.chunk)),
        "object_id": plane,
        "depth": dataclasses.replace(plane, dtype="float32"),
    }
    head = LayersHead(version=LAYERS_VERSION, kind="straight", geometry=geometry_hash, num_layers=num_layers, files={})
    _create_store(dataset, geometry, head, arrays, replace=replace)
