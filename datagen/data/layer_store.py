"""Layers on disk: a zarr store of arrays, its sealed head, a sealed record for each view.

    LAYERS/layers.json                   sealed, written first: version, kind, geometry, settings, SHA-256 of metadata
    LAYERS/peels.zarr/SPLIT/ARRAY        (view, ...): the arrays are listed in layers.py
    LAYERS/records/SPLIT/0000.json       sealed, written last: SHA-256 of the view's shards, one for each array

LAYERS is layers/straight of a geometry. One shard a view and array, blosc zstd-5 with byte shuffle: standard zarr v3
codecs only.
"""

import shlex
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast

import numpy as np

from datagen.data.config import Split
from datagen.data.paths import layers_root, view_name
from datagen.data.zarr_shard import ShardFormat, decode_shard, parse_shard_format
from datagen.disk.errors import HyalineError
from datagen.disk.opened import Opened
from datagen.disk.ownership import LAYERS
from datagen.disk.promises import check_files, read_promised
from datagen.disk.records import Json, from_json, shown
from datagen.disk.storage import load_sealed, seal_of

LAYERS_VERSION = 1
STORE = "peels.zarr"


@dataclass(frozen=True, kw_only=True)
class LayersHead:
    """What a store of layers holds."""

    version: int
    kind: Literal["straight"]
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
    """Share of the rays that were cut off: more hits than layers."""
    files: dict[str, str]


def record_path_of_layers(root: Path, split: Split, view: int) -> Path:
    return root / "records" / split / f"{view_name(view)}.json"


@dataclass(frozen=True, kw_only=True, eq=False)
class LayerStore:
    """The layers of one geometry, opened: head and metadata are verified once, a view when it is read."""

    dataset_root: Path
    geometry: str
    head: LayersHead
    seal: str
    """Of the head: names the layers in a run's record."""
    _opened: Opened = field(default_factory=Opened, repr=False)

    @property
    def root(self) -> Path:
        """The folder LAYERS."""
        return layers_root(self.dataset_root, self.geometry)

    def read(self, split: Split, view: int, only: Collection[str] | None = None) -> dict[str, np.ndarray]:
        """One view's arrays by name (or those named in `only`), every byte of them verified.

        Raises:
            HyalineError: the view is not peeled, or damaged.
        """
        formats = self._formats_of(split)
        arrays = {}
        for file, promised in self.record(split, view).files.items():
            name = Path(file).parts[2]
            if only is None or name in only:
                data = read_promised(self.root, file, promised)
                arrays[name] = decode_shard(data, formats[name], where=str(self.root / file))
        return arrays

    def record(self, split: Split, view: int) -> LayersRecord:
        """The record of one peeled view.

        Raises:
            HyalineError: not peeled, damaged, or of another store.
        """
        path = record_path_of_layers(self.root, split, view)
        if not path.is_file():
            raise HyalineError(f"{path}: the view is not peeled yet; finish with `{self.peel_command}`")
        record = from_json(LayersRecord, cast(Json, load_sealed(path)), where=str(path))
        if (record.layers, record.split, record.view) != (self.seal, split, view):
            raise HyalineError(f"{path}: belongs to {record.split} view {record.view} of other layers; peel it again")
        shards = [Path(file).parts for file in record.files]
        expected = [(STORE, split, name, "c", str(view)) for name in self._metadata_of(split)]
        if sorted(shard[:5] for shard in shards) != sorted(expected):
            raise HyalineError(
                f"{path}: promises {', '.join(sorted(record.files))}; expected its view's arrays, peel it again"
            )
        return record

    def is_peeled(self, split: Split, view: int) -> bool:
        """True when the view's record and shards verify."""
        try:
            check_files(self.root, self.record(split, view).files)
        except HyalineError:
            return False
        return True

    @property
    def peel_command(self) -> str:
        """What makes the views that are missing."""
        words = _peel_words(self.dataset_root, self.geometry)
        return shlex.join([*words, "--num-layers", str(self.head.num_layers)])

    def _formats_of(self, split: Split) -> dict[str, ShardFormat]:
        """What a shard of each array holds; all of the split's metadata is verified."""
        for file in (file for file in self.head.files if _is_of(file, split) and file.count("/") == 2):
            self._opened.get(self.root / file, lambda file=file: read_promised(self.root, file, self.head.files[file]))
        return {
            name: self._opened.get(self.root / file, lambda file=file: self._read_format(file))
            for name, file in self._metadata_of(split).items()
        }

    def _read_format(self, file: str) -> ShardFormat:
        text = read_promised(self.root, file, self.head.files[file])
        return parse_shard_format(text, where=str(self.root / file))

    def _metadata_of(self, split: Split) -> dict[str, str]:
        """The file of each array's metadata, by the array's name."""
        files = [file for file in self.head.files if file.count("/") == 3 and _is_of(file, split)]
        return {file.split("/")[2]: file for file in files}


def _is_of(file: str, split: Split) -> bool:
    return file.split("/")[1] == split


def open_layers(dataset_root: Path, geometry: str) -> LayerStore:
    """The store of a geometry's layers, its head verified.

    Raises:
        HyalineError: the geometry was not peeled, or the head is damaged.
    """
    path = layers_root(dataset_root, geometry) / LAYERS.head
    if not path.is_file():
        command = shlex.join(_peel_words(dataset_root, geometry))
        raise HyalineError(f"{path}: {geometry} has no straight layers; make them with `{command}`")
    content = load_sealed(path)
    if content.get("version") != LAYERS_VERSION:
        raise HyalineError(
            f"{path}: format version {shown(content.get('version'))}; this program reads {LAYERS_VERSION}"
        )
    head = from_json(LayersHead, cast(Json, content), where=str(path))
    return LayerStore(dataset_root=dataset_root, geometry=geometry, head=head, seal=seal_of(content))


def _peel_words(dataset_root: Path, geometry: str) -> list[str]:
    return ["datagen", "peel", str(dataset_root), "--geometry", geometry]
