"""Tests the one way from linear to sRGB and 8 bits against an independent implementation and a simulation."""

import colour
import numpy as np
import pytest

from datagen.data.config import ViewRecord
from datagen.data.images import linear_from_srgb, srgb_from_linear, to_8bit


def test_the_curve_equals_colour_sciences() -> None:
    linear = np.linspace(0, 1, 10_001)
    assert np.abs(srgb_from_linear(linear) - colour.cctf_encoding(linear, function="sRGB")).max() < 1e-12
    assert np.abs(linear_from_srgb(srgb_from_linear(linear)) - linear).max() < 1e-7


def test_radiance_beyond_one_and_below_zero_is_clipped() -> None:
    assert to_8bit(srgb_from_linear(np.array([-1.0, 0.0, 1.0, 50.0]))).tolist() == [0, 0, 255, 255]


@pytest.mark.parametrize("levels", [0.5, 1.0, 1.45, 4.0])
def test_the_ceiling_is_the_psnr_of_an_exact_picture_when_both_are_rounded_to_8_bits(levels: float) -> None:
    rng = np.random.default_rng(0)
    exact = rng.uniform(0.2, 0.8, 1_000_000)
    noisy = exact + rng.normal(0, levels / 255, exact.shape)
    error = np.mean((to_8bit(exact) / 255 - to_8bit(noisy) / 255) ** 2)
    record = ViewRecord(dataset="", split="train", view=0, noise_mse=(levels / 255) ** 2, files={})
    assert record.ceiling_db == pytest.approx(-10 * np.log10(error), abs=0.02)
