"""Tests that shards are decoded as zarr itself does it, and that bytes which are none are refused."""

from pathlib import Path

import numpy as np
import pytest
import zarr
from zarr.codecs import BloscCodec

from datagen.data.zarr_shard import ShardFormat, decode_shard, parse_shard_format
from datagen.disk.errors import HyalineError

SHAPES = [
    ((3, 8, 8), (1, 8, 8), "uint8"),
    ((2, 3, 8, 4), (1, 1, 8, 4), "uint16"),
    ((4, 6), (2, 3), "float32"),
    ((2, 5, 5), (1, 5, 5), "bool"),
]


def write_shard(folder: Path, shape: tuple[int, ...], chunk: tuple[int, ...], dtype: str) -> tuple[bytes, bytes]:
    """The metadata of an array whose second view holds numbers and one chunk of zeros, and the shard of that view."""
    array = zarr.create_array(
        folder,
        shape=(3, *shape),
        chunks=(1, *chunk),
        shards=(1, *shape),
        dtype=dtype,
        compressors=BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"),
    )
    values = np.random.default_rng(0).integers(0, 200, shape).astype(dtype)
    values[tuple(slice(0, size) for size in chunk)] = 0
    array[1] = values
    return (folder / "zarr.json").read_bytes(), folder.joinpath("c", "1", *"0" * len(shape)).read_bytes()


@pytest.mark.parametrize(("shape", "chunk", "dtype"), SHAPES)
def test_a_shard_holds_what_zarr_reads(
    shape: tuple[int, ...], chunk: tuple[int, ...], dtype: str, tmp_path: Path
) -> None:
    metadata, shard = write_shard(tmp_path, shape, chunk, dtype)
    form = parse_shard_format(metadata, where="zarr.json")
    assert (form.shape, form.chunk, form.dtype) == (shape, chunk, np.dtype(dtype))
    values = decode_shard(shard, form, where="shard")
    expected = np.asarray(zarr.open_array(tmp_path, mode="r")[1])
    assert values.dtype == expected.dtype and values.any()
    assert np.array_equal(values, expected)


def test_a_shard_that_is_none_is_refused_whatever_it_holds(tmp_path: Path) -> None:
    metadata, shard = write_shard(tmp_path, (3, 8, 8), (1, 8, 8), "uint16")
    form = parse_shard_format(metadata, where="zarr.json")
    for length in range(len(shard)):
        with pytest.raises(HyalineError, match="shard: "):
            decode_shard(shard[:length], form, where="shard")
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        spoilt = bytearray(shard)
        spoilt[rng.integers(len(spoilt))] ^= 1 << int(rng.integers(8))
        try:
            assert decode_shard(bytes(spoilt), form, where="shard").shape == (3, 8, 8)
        except HyalineError as error:
            refused += "shard: chunk" in str(error)
    assert refused > 30
    larger = ShardFormat(dtype=form.dtype, shape=(3, 8, 16), chunk=(1, 8, 16))
    with pytest.raises(HyalineError, match=r"chunk \(1, 0, 0\) is not one of 256 bytes"):
        decode_shard(shard, larger, where="shard")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'"sharding_indexed"', b'"gzip"', "codecs is 'gzip'"),
        (b'"fill_value": 0', b'"fill_value": 7', "fill_value is 7"),
        (b'"float32"', b'"object"', "data_type is 'object'"),
        (b'"chunk_grid"', b'"chunky_grid"', "KeyError"),
        (b'"little"', b'"big"', "endian is 'big'"),
    ],
)
def test_an_array_laid_out_in_another_way_is_refused(old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    metadata, _ = write_shard(tmp_path, (4, 6), (2, 3), "float32")
    assert old in metadata
    with pytest.raises(HyalineError, match=message):
        parse_shard_format(metadata.replace(old, new, 1), where="zarr.json")
