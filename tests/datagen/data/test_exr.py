"""Tests that a damaged EXR is refused, in a moment: OpenEXR itself never ends on some of them."""

import numpy as np
import pytest

from datagen.data.images import decode_exr, encode_exr
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba

pytestmark = pytest.mark.promise("R6")


@pytest.fixture(scope="module")
def good() -> bytes:
    """Of 40 rows: two blocks."""
    ramp = np.linspace(0, 1, 40 * 40 * 3, dtype=np.float32).reshape(40, 40, 3)
    return encode_exr(ramp, 0.01 * ramp)


@pytest.mark.parametrize("shape", [(1, 1), (5, 33), (32, 7), (65, 40)])
def test_an_exr_holds_half_floats_of_what_was_written_and_mitsuba_reads_the_same(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    radiance, noise = (rng.normal(size=(*shape, 3)).astype(np.float16).astype(np.float32) for _ in range(2))
    data = encode_exr(radiance, noise)
    assert data == encode_exr(radiance, noise)
    again = decode_exr(data, where="view.exr")
    assert np.array_equal(again[0], radiance) and np.array_equal(again[1], noise)
    use_mitsuba()
    import mitsuba as mi

    stream = mi.MemoryStream()
    stream.write(data)
    stream.seek(0)
    bitmap = mi.Bitmap(stream, mi.Bitmap.FileFormat.OpenEXR)
    place = {field.name: index for index, field in enumerate(bitmap.struct_())}
    assert set(place) == {"R", "G", "B", "noise.R", "noise.G", "noise.B"}
    assert np.array_equal(np.array(bitmap, np.float32)[..., place["noise.G"]], noise[..., 1])


def test_radiance_beyond_half_precision_stays_finite() -> None:
    bright = np.full((2, 2, 3), 1e6, np.float32)
    assert (decode_exr(encode_exr(bright, bright), where="view.exr")[0] == 65504).all()


def test_an_exr_cut_at_any_length_is_refused(good: bytes) -> None:
    decode_exr(good, where="view.exr")
    for length in range(len(good)):
        with pytest.raises(HyalineError, match=r"view\.exr: damaged"):
            decode_exr(good[:length], where="view.exr")


def test_a_bit_that_flipped_in_the_header_is_refused_or_read_at_once(good: bytes) -> None:
    rng = np.random.default_rng(0)
    end = good.index(b"screenWindowWidth")
    refused = 0
    for place in rng.choice(end, 150, replace=False):
        spoilt = bytearray(good)
        spoilt[place] ^= 1 << int(rng.integers(8))
        try:
            radiance, _ = decode_exr(bytes(spoilt), where="view.exr")
            assert radiance.ndim == 3
        except HyalineError as error:
            assert "view.exr: " in str(error)
            refused += 1
    assert refused > 75
