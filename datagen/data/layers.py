"""Straight layers: every surface along a pixel's ray, in memory and on disk, written head first, then view by view.

    LAYERS/layers.json                              sealed, written first: version, kind, geometry, number of layers
    LAYERS/arrays/SPLIT/0000.uv.npy.blosc           (2, layer, h, w) uint16: u, v times 65535, rounded
    LAYERS/arrays/SPLIT/0000.object_id.npy.blosc    (layer, h, w) uint8: 0 = empty
    LAYERS/arrays/SPLIT/0000.depth.npy.blosc        (layer, h, w) float32: metres along the ray, 0 where empty
    LAYERS/records/SPLIT/0000.json                  sealed, written last: SHA-256 of the view's arrays

LAYERS is layers/straight of a geometry. An array is a .npy file in one Blosc buffer (zstd-5, byte shuffle), which
`numpy.load(io.BytesIO(numcodecs.blosc.decompress(data)))` reads. uv is never filtered or resized: neighbours across a
seam do not mix. Depth keeps 16 of its 23 mantissa bits (relative error 8e-6), which compresses to two thirds.
"""

import math
import re
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, cast

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from datagen.data.config import Resolution, Split
from datagen.data.paths import TRUTH, layers_root
from datagen.disk.errors import HyalineError, shown
from datagen.disk.ownership import LAYERS, begin
from datagen.disk.records import Json, commit_sealed, from_json, load_sealed, seal_of, to_json
from datagen.disk.storage import check_files, commit_all, read_promised

LAYERS_VERSION = 2

DTYPES = {"uv": np.dtype("<u2"), "object_id": np.dtype("|u1"), "depth": np.dtype("<f4")}
"""Types of a view's arrays, by name."""

UV_SCALE = 65535

MAX_ARRAY_BYTES = (1 << 31) - 256
"""The largest array that fits into a Blosc buffer with its header."""

MAX_WORKERS = 1024
"""Processes; a larger number is probably a typo."""


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
    kind: Literal["straight"]
    geometry: str
    """Hash over the meshes that were peeled."""
    num_layers: int


@dataclass(frozen=True, kw_only=True)
class LayersRecord:
    """One peeled view."""

    layers: str
    """The seal of the store's head."""
    split: Split
    view: int
    num_layers: int
    overflow_share: float
    """Share of rays that have more hits than layers."""
    files: dict[str, str]
    """SHA-256 by path, relative to the store."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LayerStore:
    """The layers of one geometry, opened: the head is verified once, a view when it is read."""

    dataset_root: Path
    geometry: str
    resolution: Resolution
    head: LayersHead
    seal: str
    """Digest of the head, by which a run's record names the layers."""

    @cached_property
    def root(self) -> Path:
        """The folder LAYERS."""
        return layers_root(self.dataset_root, self.geometry)

    def read(self, split: Split, view: int, only: Collection[str] = tuple(DTYPES)) -> dict[str, np.ndarray]:
        """One view's arrays by name (or those named in `only`), every byte of them verified."""
        promised = self.record(split, view).files
        arrays = {}
        for name in only:
            file = array_file(split, view, name)
            data = read_promised(self.root, file, promised[file])
            shape = array_shape(name, self.head.num_layers, self.resolution)
            arrays[name] = decode_array(data, DTYPES[name], shape, where=str(self.root / file))
        return arrays

    def record(self, split: Split, view: int) -> LayersRecord:
        """The record of one peeled view."""
        path = record_path_of_layers(self.root, split, view)
        if not path.is_file():
            raise HyalineError(f"{path}: the view is not peeled yet; finish with `datagen peel`")
        record = from_json(LayersRecord, cast(Json, load_sealed(path)), where=str(path))
        if (record.layers, record.split, record.view) != (self.seal, split, view):
            raise HyalineError(f"{path}: belongs to {record.split} view {record.view} of other layers; peel it again")
        if set(record.files) != {array_file(split, view, name) for name in DTYPES}:
            raise HyalineError(f"{path}: promises other files than its view's arrays; peel it again")
        return record

    def is_peeled(self, split: Split, view: int) -> bool:
        """True when the view's record and arrays verify."""
        try:
            check_files(self.root, self.record(split, view).files)
        except HyalineError:
            return False
        return True

    def write(self, split: Split, view: int, layers: Layers, *, overflow_share: float) -> None:
        """Commits one view's layers: their arrays, then the record."""
        values = {
            "uv": np.moveaxis(layers.uv, -1, 0),
            "object_id": layers.object_id,
            "depth": round_mantissa(layers.depth),
        }
        arrays = {
            array_file(split, view, name): encode_array(value.astype(DTYPES[name], copy=False))
            for name, value in values.items()
        }
        record = LayersRecord(
            layers=self.seal,
            split=split,
            view=view,
            num_layers=self.head.num_layers,
            overflow_share=overflow_share,
            files=commit_all(self.root, arrays),
        )
        commit_sealed(record_path_of_layers(self.root, split, view), cast(dict[str, Json], to_json(record)))


def open_layers(dataset_root: Path, geometry: str, resolution: Resolution) -> LayerStore:
    """The store of a geometry's layers, its head verified."""
    path = layers_root(dataset_root, geometry) / LAYERS.head
    if not path.is_file():
        makers = "" if geometry == TRUTH else " (a missing geometry by `proxies make` or `model fit`)"
        raise HyalineError(f"{path}: {geometry} has no straight layers; make them with `datagen peel`{makers}")
    content = load_sealed(path)
    if content.get("version") != LAYERS_VERSION:
        raise HyalineError(
            f"{path}: format version {shown(content.get('version'))}; this program reads {LAYERS_VERSION}, "
            "make them again with `datagen peel --overwrite`"
        )
    head = from_json(LayersHead, cast(Json, content), where=str(path))
    return LayerStore(
        dataset_root=dataset_root, geometry=geometry, resolution=resolution, head=head, seal=seal_of(content)
    )


def check_settings(*, num_layers: int, workers: int) -> None:
    """Checks settings before any work is done."""
    if not isinstance(num_layers, int) or not 1 <= num_layers <= 255:
        raise HyalineError(f"num_layers: is {num_layers}; expected 1 to 255")
    if not 1 <= workers <= MAX_WORKERS:
        raise HyalineError(f"workers: is {workers}; expected 1 to {MAX_WORKERS}")


def start_layers(
    root: Path, resolution: Resolution, *, num_layers: int, geometry_hash: str, replace: bool = False
) -> None:
    """Commits the head of the store in the folder `root`. Of several processes at once, one of their heads stays.

    Args:
        replace: replace an existing head; views that verify under the new one are kept.
    """
    largest = max(math.prod(array_shape(name, 1, resolution)) * dtype.itemsize for name, dtype in DTYPES.items())
    if num_layers * largest > MAX_ARRAY_BYTES:
        raise HyalineError(
            f"num_layers: {num_layers} layers of {resolution} pixels do not fit into a file; expected at most "
            f"{MAX_ARRAY_BYTES // largest}"
        )
    head = LayersHead(version=LAYERS_VERSION, kind="straight", geometry=geometry_hash, num_layers=num_layers)
    begin(root, LAYERS, cast(dict[str, Json], to_json(head)), replace=replace)


def record_path_of_layers(root: Path, split: Split, view: int) -> Path:
    return root / f"records/{split}/{view:04d}.json"


def array_file(split: Split, view: int, name: str) -> str:
    """Where a view's array lies, relative to LAYERS."""
    return f"arrays/{split}/{view:04d}.{name}.npy.blosc"


def layers_files(root: Path) -> list[str]:
    """The files of a folder of layers besides its head, by relative path, records first: all that have their names."""
    is_record, is_array = r"[0-9]{4,}\.json", rf"[0-9]{{4,}}\.({'|'.join(DTYPES)})\.npy\.blosc"
    records = [path for path in sorted(root.glob("records/*/*")) if re.fullmatch(is_record, path.name)]
    arrays = [path for path in sorted(root.glob("arrays/*/*")) if re.fullmatch(is_array, path.name)]
    return [path.relative_to(root).as_posix() for path in (*records, *arrays)]


def array_shape(name: str, num_layers: int, resolution: Resolution) -> tuple[int, ...]:
    """The shape of a view's array."""
    return (*((2,) if name == "uv" else ()), num_layers, *resolution.shape)


def decode_array(data: bytes, dtype: np.dtype, shape: tuple[int, ...], *, where: str) -> np.ndarray:
    """The array in the bytes of its file, which has to have this type and shape."""
    # numcodecs 0.16 describes none of its compiled modules.
    from numcodecs import blosc  # pyright: ignore[reportAttributeAccessIssue]

    header = npy_header(dtype, shape)
    size = len(header) + math.prod(shape) * dtype.itemsize
    # Blosc believes its own header: what it is given must be a whole buffer, of the size that is expected.
    _, length, _, stored = np.frombuffer(data[:16].ljust(16, b"\0"), "<u4").tolist()
    if (length, stored) != (size, len(data)):
        raise HyalineError(f"{where}: is not a Blosc buffer of {size:,} bytes; peel it again")
    npy = np.empty(size, np.uint8)
    try:
        blosc.decompress(data, npy)
    except (RuntimeError, ValueError) as error:
        raise HyalineError(f"{where}: cannot be decompressed ({error}); peel it again") from error
    if npy[: len(header)].tobytes() != header:
        raise HyalineError(f"{where}: is not a .npy file of {dtype} with shape {shape}; peel it again")
    return npy[len(header) :].view(dtype).reshape(shape)


def encode_array(values: np.ndarray) -> bytes:
    """The bytes of an array's file."""
    # numcodecs 0.16 describes none of its compiled modules.
    from numcodecs import blosc  # pyright: ignore[reportAttributeAccessIssue]

    # With several threads, the order of blocks would depend on timing.
    blosc.use_threads = False
    npy = npy_header(values.dtype, values.shape) + values.tobytes()
    return blosc.compress(npy, b"zstd", 5, blosc.SHUFFLE, typesize=values.itemsize)


def npy_header(dtype: np.dtype, shape: tuple[int, ...]) -> bytes:
    """The first bytes of an array's .npy file (version 1.0), the same whatever version of NumPy is installed."""
    text = f"{{'descr': '{dtype.str}', 'fortran_order': False, 'shape': {shape}, }}"
    text = text.ljust(math.ceil((len(text) + 11) / 64) * 64 - 11) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def quantize_uv(uv: Float32[np.ndarray, "*shape 2"]) -> UInt16[np.ndarray, "*shape 2"]:
    """16-bit uv; the error is at most 7.6e-6, 0.03 of a texel even at 4096 texels."""
    return np.rint(np.clip(uv.astype(np.float64), 0, 1) * UV_SCALE).astype(np.uint16)


def round_mantissa(values: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Floats with 16 of their 23 mantissa bits, rounded to nearest; relative error at most 7.7e-6."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + np.uint32(0x40)) & np.uint32(0xFFFFFF80)).view(np.float32)
