"""Tests the one way from linear to sRGB against an independent implementation."""

import colour
import numpy as np

from datagen.data.images import linear_from_srgb, srgb_from_linear, to_8bit


def test_the_curve_equals_colour_sciences() -> None:
    linear = np.linspace(0, 1, 10_001)
    assert np.abs(srgb_from_linear(linear) - colour.cctf_encoding(linear, function="sRGB")).max() < 1e-12
    assert np.abs(linear_from_srgb(srgb_from_linear(linear)) - linear).max() < 1e-7


def test_radiance_beyond_one_and_below_zero_is_clipped() -> None:
    assert to_8bit(srgb_from_linear(np.array([-1.0, 0.0, 1.0, 50.0]))).tolist() == [0, 0, 255, 255]
