"""Tests of the files of layers: another program reads them in a few lines, and bytes that are not one are refused."""

import re
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import write_synthetic_dataset

from datagen.data.config import square
from datagen.data.layers import decode_array, encode_array, start_layers
from datagen.disk.errors import HyalineError

SHAPE, UINT16 = (3, 8, 8), np.dtype("<u2")
VALUES = np.random.default_rng(0).integers(0, 200, SHAPE).astype(UINT16)


def test_the_lines_of_the_documentation_read_layers_without_hyaline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data/glass_table", resolution=8, train_views=1)
    page = Path(__file__).parents[3] / "docs/datasets.md"
    (lines,) = re.findall(r"```python\n(import io\n.*?)```", page.read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    found: dict[str, np.ndarray] = {}
    exec(lines, found)
    layers = dataset.view("train", 0).layers()
    assert np.array_equal(np.moveaxis(found["uv"], 0, -1), layers.uv) and layers.uv.any()
    assert np.array_equal(found["object_id"], layers.object_id)
    assert np.array_equal(found["depth"], layers.depth)


@pytest.mark.parametrize("dtype", ["<u2", "|u1", "<f4"])
def test_an_array_comes_back_as_it_was_and_its_bytes_are_always_the_same(dtype: str) -> None:
    values = np.zeros((2, 40, 300, 200), dtype)  # Several of Blosc's blocks, of zeros and of numbers.
    values[1, :20] = np.random.default_rng(0).integers(0, 200, (20, 300, 200))
    data = encode_array(values)
    assert all(encode_array(values) == data for _ in range(3))
    found = decode_array(data, np.dtype(dtype), values.shape, where="0000.uv.npy.blosc")
    assert found.dtype == values.dtype and np.array_equal(found, values)


def test_a_file_that_is_none_is_refused_whatever_it_holds() -> None:
    data = encode_array(VALUES)
    for length in range(len(data)):
        with pytest.raises(HyalineError, match="file: "):
            decode_array(data[:length], UINT16, SHAPE, where="file")
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        spoilt = bytearray(data)
        spoilt[rng.integers(len(spoilt))] ^= 1 << int(rng.integers(8))
        try:
            assert decode_array(bytes(spoilt), UINT16, SHAPE, where="file").shape == SHAPE
        except HyalineError as error:
            refused += str(error).startswith("file: ")
    assert refused > 30


@pytest.mark.parametrize(
    ("dtype", "shape", "message"),
    [
        ("<u2", (3, 8, 16), "is not a Blosc buffer of 896 bytes"),
        ("<u2", (3, 16, 4), r"is not a \.npy file of uint16 with shape \(3, 16, 4\)"),
        ("<i2", SHAPE, r"is not a \.npy file of int16"),
    ],
)
def test_an_array_of_another_type_or_shape_is_refused(dtype: str, shape: tuple[int, ...], message: str) -> None:
    with pytest.raises(HyalineError, match=message):
        decode_array(encode_array(VALUES), np.dtype(dtype), shape, where="file")


def test_layers_that_do_not_fit_into_a_file_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(HyalineError, match="9 layers of 8000 x 8000 pixels do not fit into a file; expected at most 8"):
        start_layers(tmp_path, square(8000), num_layers=9, geometry_hash="")
    assert not list(tmp_path.iterdir())
