"""Owns how layers of any kind lie on disk: a zarr store of arrays, its sealed head, a sealed record for each view.

    LAYERS/layers.json                   sealed, written first: version, kind, geometry, settings, SHA-256 of metadata
    LAYERS/peels.zarr/SPLIT/ARRAY        (view, ...): a kind's arrays are listed in its own file
    LAYERS/records/SPLIT/0000.json       sealed, written last: SHA-256 of the view's shards, one for each array

LAYERS is layers/KIND of a geometry. One shard a view and array, blosc zstd-5 with byte shuffle: standard zarr v3 codecs
only.
"""

import dataclasses
import shlex
import tempfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np

from datagen.data.cameras import subpixel_offsets
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.paths import geometry_root, view_name
from datagen.disk.errors import DamagedError, HyalineError
from datagen.disk.heads import keep_head
from datagen.disk.names import check_relative
from datagen.disk.os_errors import naming
from datagen.disk.ownership import LAYERS, begin, is_ours
from datagen.disk.promises import check_files
from datagen.disk.reading import load_json
from datagen.disk.records import Json, from_json, shown, to_json
from datagen.disk.storage import (
    SEAL,
    commit_same,
    commit_sealed,
    load_sealed,
    seal_bytes,
    seal_of,
    sha256,
    sha256_file,
)

LAYERS_VERSION = 1
STORE = "peels.zarr"

LayerKind = Literal["straight", "light-path"]
LAYER_KINDS: tuple[LayerKind, ...] = ("straight", "light-path")
MAX_RAYS = 1024
"""A pixel."""


@dataclass(frozen=True, kw_only=True)
class LayersHead:
    """What a store of straight layers holds."""

    version: int
    kind: Literal["straight"]
    geometry: str
    """Hash over the meshes that were peeled."""
    num_layers: int
    files: dict[str, str]
    """SHA-256 of the zarr metadata, by path relative to the store."""


@dataclass(frozen=True, kw_only=True)
class LightPathsHead:
    """What a store of light paths holds."""

    version: int
    kind: Literal["light-path"]
    geometry: str
    """Hash over the meshes that were traced."""
    num_branches: int
    max_vertices: int
    """Vertices kept of each branch; the last place holds the last vertex."""
    max_depth: int
    """Surfaces after which a branch was given up."""
    samples: int
    """Rays per pixel, a square number."""
    files: dict[str, str]
    """SHA-256 of the zarr metadata, by path relative to the store."""


Head = LayersHead | LightPathsHead


@dataclass(frozen=True, kw_only=True)
class LayersRecord:
    """One peeled view."""

    layers: str
    """The seal of the store's head."""
    split: Split
    view: int
    overflow_share: float
    """Share of the rays that were cut off: more hits than layers, or a branch that was given up."""
    files: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class ArrayFormat:
    """What an array holds for each view."""

    dtype: str
    axes: tuple[str, ...]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    """Shape of the pieces that are compressed one by one."""


def layers_root(root: Path, geometry: str, kind: LayerKind) -> Path:
    return geometry_root(root, geometry) / "layers" / kind


def record_path_of_layers(root: Path, split: Split, view: int) -> Path:
    return root / "records" / split / f"{view_name(view)}.json"


def create_store(dataset: Dataset, geometry: str, head: Head, arrays: Mapping[str, ArrayFormat], *,
                 replace: bool = False) -> None:  # fmt: skip
    """Commits the head of a store (whose `files` are filled in), then zarr's metadata: an empty store.

    Several processes may do the same at once: the bytes are the same, and no view that is there is touched. Of a store
    that stands there, metadata that is missing or damaged is written again.

    Args:
        replace: take the place of a head that stands there; views that verify under the new one are kept.

    Raises:
        DamagedError: metadata that stands there is damaged, and this version of zarr writes other bytes.
        HyalineError: something else stands there.
    """
    root = layers_root(dataset.root, geometry, head.kind)
    stands = not replace and is_ours(root, LAYERS)
    promised = read_layers_head(dataset, geometry, head.kind)[0].files if stands else {}
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


def check_settings(*, num_layers: int, rays: int, workers: int, kinds: tuple[LayerKind, ...]) -> None:
    """Refuses how layers cannot be made, before anything is done.

    Raises:
        HyalineError: naming the number.
    """
    if not kinds:
        raise HyalineError("layers: is empty; expected straight, light-path or both")
    if not 1 <= num_layers <= 255:
        raise HyalineError(f"num_layers: is {num_layers}; expected 1 to 255")
    if workers < 1:
        raise HyalineError(f"workers: is {workers}; expected at least 1")
    if rays > MAX_RAYS:
        raise HyalineError(f"rays: is {rays}; expected at most {MAX_RAYS}")
    subpixel_offsets(rays)


def read_layers_head(dataset: Dataset, geometry: str, kind: LayerKind) -> tuple[Head, str]:
    """The head of a store and its seal.

    Raises:
        HyalineError: the geometry was not peeled, or the head is damaged or of another kind.
    """
    path = layers_root(dataset.root, geometry, kind) / "layers.json"
    if not path.is_file():
        raise HyalineError(
            f"{path}: {geometry} has no {kind} layers; make them with `{_peel_command(dataset, geometry, kind)}`"
        )
    content = load_sealed(path)
    if content.get("version") != LAYERS_VERSION:
        raise HyalineError(
            f"{path}: format version {shown(content.get('version'))}; this program reads {LAYERS_VERSION}"
        )
    classes: dict[LayerKind, type[Head]] = {"straight": LayersHead, "light-path": LightPathsHead}
    return from_json(classes[kind], cast(Json, content), where=str(path)), cast(str, load_json(path)[SEAL])


def write_view(dataset: Dataset, geometry: str, kind: LayerKind, split: Split, view: int,
               values: Mapping[str, np.ndarray], *, overflow_share: float) -> None:  # fmt: skip
    """Commits one view's arrays: their shards, then the record."""
    import zarr

    root = layers_root(dataset.root, geometry, kind)
    _, seal = read_layers_head(dataset, geometry, kind)
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
    record = LayersRecord(layers=seal, split=split, view=view, overflow_share=overflow_share, files=files)
    commit_sealed(record_path, cast(dict[str, Json], to_json(record)))


def read_layers_record(dataset: Dataset, geometry: str, kind: LayerKind, split: Split, view: int) -> LayersRecord:
    """The record of one peeled view.

    Raises:
        HyalineError: not peeled, damaged, or of another store.
    """
    root = layers_root(dataset.root, geometry, kind)
    head, seal = read_layers_head(dataset, geometry, kind)
    path = record_path_of_layers(root, split, view)
    if not path.is_file():
        raise HyalineError(
            f"{path}: the view is not peeled yet; finish with `{_peel_command(dataset, geometry, kind)}`"
        )
    record = from_json(LayersRecord, cast(Json, load_sealed(path)), where=str(path))
    if (record.layers, record.split, record.view) != (seal, split, view):
        raise HyalineError(f"{path}: belongs to {record.split} view {record.view} of other layers; peel it again")
    arrays = {Path(file).parts[2] for file in head.files if file.count("/") == 3 and file.split("/")[1] == split}
    shards = [Path(file).parts for file in record.files]
    if sorted(shard[:5] for shard in shards) != sorted((STORE, split, name, "c", str(view)) for name in arrays):
        raise HyalineError(f"{path}: promises {', '.join(sorted(record.files))}; expected its view's arrays, "
                           "peel it again")  # fmt: skip
    return record


def read_view(dataset: Dataset, geometry: str, kind: LayerKind, split: Split, view: int,
              only: Collection[str] | None = None) -> dict[str, np.ndarray]:  # fmt: skip
    """One view's arrays by name (or those named in `only`), every byte of them verified."""
    import zarr

    root = layers_root(dataset.root, geometry, kind)
    head, _ = read_layers_head(dataset, geometry, kind)
    metadata = {key: value for key, value in head.files.items() if f"/{split}/" in key}
    shards = read_layers_record(dataset, geometry, kind, split, view).files
    shards = {path: promised for path, promised in shards.items() if only is None or Path(path).parts[2] in only}
    check_files(root, metadata | shards)
    group = zarr.open_group(root / STORE / split, mode="r")
    names = [Path(path).parts[2] for path in shards]
    return {name: np.asarray(cast(zarr.Array, group[name])[view]) for name in names}


def is_view_peeled(dataset: Dataset, geometry: str, kind: LayerKind, split: Split, view: int) -> bool:
    """True when the view's record and shards verify."""
    try:
        files = read_layers_record(dataset, geometry, kind, split, view).files
        check_files(layers_root(dataset.root, geometry, kind), files)
    except HyalineError:
        return False
    return True


def _peel_command(dataset: Dataset, geometry: str, kind: LayerKind) -> str:
    words = ["datagen", "peel", "--dataset", str(dataset.root), "--geometry", geometry]
    words += [] if kind == "straight" else ["--layers", kind]
    if (layers_root(dataset.root, geometry, kind) / "layers.json").is_file():
        head, _ = read_layers_head(dataset, geometry, kind)
        if isinstance(head, LayersHead):
            words += ["--num-layers", str(head.num_layers)]
        else:
            words += ["--num-layers", str(head.max_vertices), "--rays", str(head.samples)]
    return shlex.join(words)
