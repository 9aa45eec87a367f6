"""One shard of a zarr array, decoded from its bytes: zarr itself takes ten times as long over small pieces."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from datagen.disk.errors import HyalineError
from datagen.disk.reading import parse_json
from datagen.disk.records import Json

_NO_CHUNK = 2**64 - 1
"""Offset and size of a chunk that is left out, since all of it is 0."""
_INDEX = [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "crc32c"}]
MAX_BYTES = 1 << 32
"""Of a shard when decoded: 16 layers of uv at 8,192 pixels a side."""


@dataclass(frozen=True, kw_only=True)
class ShardFormat:
    """What every shard of an array holds, as the array's zarr.json says."""

    dtype: np.dtype
    shape: tuple[int, ...]
    """Of a shard, without the first axis, of which it has one place."""
    chunk: tuple[int, ...]
    """Of the pieces that are compressed one by one."""


def parse_shard_format(metadata: bytes, *, where: str) -> ShardFormat:
    """The format in the bytes of an array's zarr.json.

    Raises:
        HyalineError: an array that is not laid out as this package does it.
    """
    content = parse_json(metadata, where=where)
    try:
        form = _parse(content)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise HyalineError(
            f"{where}: not an array of layers ({type(error).__name__}: {error}); peel it again with --overwrite"
        ) from error
    size = math.prod(form.shape) * form.dtype.itemsize
    if size > MAX_BYTES:
        raise HyalineError(f"{where}: a view takes {size:,} bytes; expected at most {MAX_BYTES:,}")
    return form


def _parse(content: Mapping[str, Json]) -> ShardFormat:
    grid = cast(dict, content["chunk_grid"])
    (sharding,) = cast(list[dict], content["codecs"])
    settings = sharding["configuration"]
    inner = [codec["name"] for codec in settings["codecs"]]
    endian = settings["codecs"][0].get("configuration", {}).get("endian", "little")
    shape, chunk = grid["configuration"]["chunk_shape"], settings["chunk_shape"]
    for name, value, expected in (
        ("zarr_format", content["zarr_format"], 3),
        ("fill_value", content["fill_value"], 0),
        ("chunk_grid", grid["name"], "regular"),
        ("codecs", sharding["name"], "sharding_indexed"),
        ("codecs in a shard", inner, ["bytes", "blosc"]),
        ("endian", endian, "little"),
        ("index_codecs", settings["index_codecs"], _INDEX),
        ("index_location", settings["index_location"], "end"),
        ("axes", len(chunk), len(shape)),
        ("first axis", (shape[0], chunk[0]), (1, 1)),
        ("chunks that fill a shard", all(0 < size and not whole % size for whole, size in zip(shape, chunk)), True),
    ):
        if value != expected:
            raise ValueError(f"{name} is {value!r}; expected {expected!r}")
    dtype = np.dtype(cast(str, content["data_type"])).newbyteorder("<")
    if dtype.kind not in "buif":
        raise ValueError(f"data_type is {content['data_type']!r}; expected numbers")
    return ShardFormat(dtype=dtype, shape=tuple(shape[1:]), chunk=tuple(chunk[1:]))


def decode_shard(data: bytes, form: ShardFormat, *, where: str) -> np.ndarray:
    """The array in the bytes of a shard.

    Raises:
        HyalineError: its index or one of its chunks is not what the format says.
    """
    # numcodecs 0.16 describes none of its compiled modules.
    from numcodecs import blosc  # pyright: ignore[reportAttributeAccessIssue]

    grid = tuple(whole // size for whole, size in zip(form.shape, form.chunk))
    count = math.prod(grid)
    end = len(data) - 16 * count - 4
    if end < 0:
        raise HyalineError(f"{where}: holds {len(data):,} bytes; expected an index of {count} chunks, peel it again")
    index = np.frombuffer(data, "<u8", 2 * count, end).reshape(count, 2)
    size = math.prod(form.chunk) * form.dtype.itemsize
    values = np.zeros(form.shape, form.dtype)
    for place, (start, length) in zip(np.ndindex(grid), index.tolist()):
        if start == length == _NO_CHUNK:
            continue
        # What blosc is given must be a whole buffer of the size that is expected: it believes its header.
        if start + length > end or length < 16 or _blosc_sizes(data, start) != (size, length):
            raise HyalineError(f"{where}: chunk {place} is not one of {size:,} bytes; peel it again")
        try:
            chunk = blosc.decompress(data[start : start + length])
        except (RuntimeError, ValueError) as error:
            raise HyalineError(f"{where}: chunk {place} cannot be decompressed ({error}); peel it again") from error
        region = tuple(slice(at * side, (at + 1) * side) for at, side in zip(place, form.chunk))
        values[region] = np.frombuffer(chunk, form.dtype).reshape(form.chunk)
    return values


def _blosc_sizes(data: bytes, start: int) -> tuple[int, int]:
    """How many bytes a blosc buffer says that it decompresses to, and how many it has."""
    _, decompressed, _, compressed = np.frombuffer(data, "<u4", 4, start).tolist()
    return decompressed, compressed
