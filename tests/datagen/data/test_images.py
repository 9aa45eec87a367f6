"""Tests of pictures: linear to sRGB and 8 bits, and EXRs, of which OpenEXR itself never ends on damaged ones."""

import colour
import numpy as np
import pytest

from datagen.data.config import ViewRecord
from datagen.data.images import decode_exr, encode_exr, linear_from_srgb, srgb_from_linear, to_8bit
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba


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


def test_radiance_beyond_half_precision_stays_finite_and_is_clipped_for_8_bits() -> None:
    bright = np.full((2, 2, 3), 1e6, np.float32)
    assert (decode_exr(encode_exr(bright, bright), where="view.exr")[0] == 65504).all()
    assert to_8bit(srgb_from_linear(np.array([-1.0, 0.0, 1.0, 50.0]))).tolist() == [0, 0, 255, 255]


@pytest.mark.promise("R6")
def test_an_exr_cut_at_any_length_is_refused(good: bytes) -> None:
    decode_exr(good, where="view.exr")
    for length in range(len(good)):
        with pytest.raises(HyalineError, match=r"view\.exr: damaged"):
            decode_exr(good[:length], where="view.exr")


@pytest.mark.promise("R6")
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


def test_the_curve_equals_colour_sciences() -> None:
    linear = np.linspace(0, 1, 10_001)
    assert np.abs(srgb_from_linear(linear) - colour.cctf_encoding(linear, function="sRGB")).max() < 1e-12
    assert np.abs(linear_from_srgb(srgb_from_linear(linear)) - linear).max() < 1e-7


@pytest.mark.parametrize("levels", [0.5, 1.0, 1.45, 4.0])
def test_the_ceiling_is_the_psnr_of_an_exact_picture_when_both_are_rounded_to_8_bits(levels: float) -> None:
    rng = np.random.default_rng(0)
    exact = rng.uniform(0.2, 0.8, 1_000_000)
    noisy = exact + rng.normal(0, levels / 255, exact.shape)
    error = np.mean((to_8bit(exact) / 255 - to_8bit(noisy) / 255) ** 2)
    record = ViewRecord(dataset="", split="train", view=0, noise_mse=(levels / 255) ** 2, files={})
    assert record.ceiling_db == pytest.approx(-10 * np.log10(error), abs=0.02)
