"""Tests that a damaged EXR is refused, in a moment: OpenEXR itself never ends on some of them."""

import numpy as np
import pytest

from datagen.data.exr import check_exr
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.render.truth import Truth, radiance_bytes, read_radiance

pytestmark = pytest.mark.promise("R6")


@pytest.fixture(scope="module")
def good() -> bytes:
    """Of 40 rows: two blocks."""
    use_mitsuba(quiet=True)
    ramp = np.linspace(0, 1, 40 * 40 * 3, dtype=np.float32).reshape(40, 40, 3)
    return radiance_bytes(Truth(radiance=ramp, half_difference=0.01 * ramp, spp=4, noise_mse=1e-5))


def test_an_exr_cut_at_any_length_is_refused(good: bytes) -> None:
    check_exr(good, where="view.exr")
    for length in range(len(good)):
        with pytest.raises(HyalineError, match=r"view\.exr: damaged"):
            check_exr(good[:length], where="view.exr")


def test_a_bit_that_flipped_in_the_header_is_refused_or_read_at_once(good: bytes) -> None:
    rng = np.random.default_rng(0)
    end = good.index(b"screenWindowWidth")
    refused = 0
    for place in rng.choice(end, 150, replace=False):
        spoilt = bytearray(good)
        spoilt[place] ^= 1 << int(rng.integers(8))
        try:
            radiance, _ = read_radiance(bytes(spoilt), where="view.exr")
            assert radiance.ndim == 3
        except HyalineError as error:
            assert "view.exr: " in str(error)
            refused += 1
    assert refused > 75
