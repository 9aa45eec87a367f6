"""Writing layers: the head of a store, then view by view."""

import contextlib
import math
import re
from pathlib import Path
from typing import cast

import numpy as np

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.layers import (
    DTYPES,
    LAYERS_VERSION,
    Layers,
    LayersHead,
    LayersRecord,
    array_file,
    array_shape,
    npy_header,
    record_path_of_layers,
    round_mantissa,
)
from datagen.data.paths import layers_root
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import LAYERS, begin, is_ours
from datagen.disk.records import Json, to_json
from datagen.disk.storage import commit, commit_sealed, load_sealed, seal_bytes, sha256

MAX_ARRAY_BYTES = (1 << 31) - 256
"""The largest array that fits into a Blosc buffer with its header."""


MAX_WORKERS = 1024
"""Processes; a larger number is probably a typo."""


def check_settings(*, num_layers: int, workers: int) -> None:
    """Checks settings before any work is done.

    Raises:
        HyalineError: naming the number.
    """
    if not isinstance(num_layers, int) or not 1 <= num_layers <= 255:
        raise HyalineError(f"num_layers: is {num_layers}; expected 1 to 255")
    if not 1 <= workers <= MAX_WORKERS:
        raise HyalineError(f"workers: is {workers}; expected 1 to {MAX_WORKERS}")


def create_layers(
    dataset: Dataset, geometry: str, *, num_layers: int, geometry_hash: str, replace: bool = False
) -> None:
    """Commits the head of a store. Several processes may do so at once: one of their heads stays.

    Args:
        replace: replace an existing head; views that verify under the new one are kept.

    Raises:
        HyalineError: the folder holds something else, or the arrays would be too large.
    """
    _check_size(dataset, num_layers)
    root = layers_root(dataset.root, geometry)
    head = LayersHead(version=LAYERS_VERSION, kind="straight", geometry=geometry_hash, num_layers=num_layers)
    content = cast(dict[str, Json], to_json(head))
    if not is_ours(root, LAYERS):
        begin(root, LAYERS, seal_bytes(content))
    elif replace:
        commit_sealed(root / LAYERS.head, content)


def _check_size(dataset: Dataset, num_layers: int) -> None:
    resolution = dataset.config.resolution
    largest = max(math.prod(array_shape(name, 1, resolution)) * dtype.itemsize for name, dtype in DTYPES.items())
    if num_layers * largest > MAX_ARRAY_BYTES:
        raise HyalineError(
            f"num_layers: {num_layers} layers of {resolution} pixels do not fit into a file; expected at most "
            f"{MAX_ARRAY_BYTES // largest}"
        )


def _record(path: Path) -> dict[str, Json]:
    """The content of a view's record; empty if it is damaged or something else."""
    try:
        content = load_sealed(path)
    except HyalineError:
        return {}
    return content if "layers" in content else {}


def write_layers(
    dataset: Dataset, geometry: str, split: Split, view: int, layers: Layers, *, overflow_share: float
) -> None:
    """Commits one view's layers: their arrays, then the record."""
    store = dataset.layer_store(geometry)
    values = {
        "uv": np.moveaxis(layers.uv, -1, 0),
        "object_id": layers.object_id,
        "depth": round_mantissa(layers.depth),
    }
    files = {}
    for name, value in values.items():
        file, data = array_file(split, view, name), encode_array(value.astype(DTYPES[name], copy=False))
        commit(store.root / file, data)
        files[file] = sha256(data)
    record = LayersRecord(
        layers=store.seal,
        split=split,
        view=view,
        num_layers=store.head.num_layers,
        overflow_share=overflow_share,
        files=files,
    )
    commit_sealed(record_path_of_layers(store.root, split, view), cast(dict[str, Json], to_json(record)))


def encode_array(values: np.ndarray) -> bytes:
    """The bytes of an array's file."""
    # numcodecs 0.16 describes none of its compiled modules.
    from numcodecs import blosc  # pyright: ignore[reportAttributeAccessIssue]

    # With several threads, the order of blocks would depend on timing.
    blosc.use_threads = False
    npy = npy_header(values.dtype, values.shape) + values.tobytes()
    return blosc.compress(npy, b"zstd", 5, blosc.SHUFFLE, typesize=values.itemsize)


def find_num_layers(dataset: Dataset, geometry: str) -> int | None:
    """How many layers a geometry was peeled into; None if it was not."""
    with contextlib.suppress(HyalineError):
        return dataset.layer_store(geometry).head.num_layers


def layers_files(root: Path) -> list[str]:
    """The files of a folder of layers besides its head, by relative path, records first.

    Arrays are found by name, since no record lists one whose writing was interrupted.
    """
    records = [path for path in sorted(root.glob("records/*/*.json")) if _record(path)]
    is_array = re.compile(rf"[0-9]{{4,}}\.({'|'.join(DTYPES)})\.npy\.blosc")
    arrays = [path for path in sorted(root.glob("arrays/*/*")) if is_array.fullmatch(path.name)]
    return [path.relative_to(root).as_posix() for path in (*records, *arrays)]
