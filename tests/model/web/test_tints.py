"""Tests how a page stores the texels of metals."""

import numpy as np

from datagen.data.tonemap import linear_from_srgb
from model.web.packing import Packed
from model.web.tints import add_tints

CODES = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
IMAGE = linear_from_srgb(CODES / 255.0).astype(np.float32)
TURNED = IMAGE.reshape(7, 5, 3)


def test_each_image_is_stored_once_as_it_is() -> None:
    packed = Packed()
    assert add_tints(packed, (None, IMAGE, TURNED, IMAGE.copy()), "exact") == [None, [0, 7, 5], [35, 5, 7], [0, 7, 5]]
    assert [(entry["name"], entry["dtype"], entry["shape"]) for entry in packed.entries] == [
        ("tints", "float32", [70, 3])
    ]
    stored = np.frombuffer(packed.parts[0], np.uint8).reshape(3, 4, 70).transpose(2, 0, 1)
    assert np.array_equal(np.ascontiguousarray(stored).view(np.float32)[..., 0], np.tile(IMAGE.reshape(-1, 3), (2, 1)))


def test_a_small_page_stores_the_numbers_of_an_8_bit_image() -> None:
    packed = Packed()
    assert add_tints(packed, (IMAGE,), "small") == [[0, 7, 5]]
    steps = np.frombuffer(packed.parts[0], np.uint8).reshape(3, 35).T
    differences = (steps >> 1) ^ -(steps & 1)
    assert np.array_equal(np.cumsum(differences, axis=0, dtype=np.uint8), CODES.reshape(-1, 3))


def test_where_every_metal_has_one_colour_nothing_is_stored() -> None:
    packed = Packed()
    assert add_tints(packed, (None, None), "small") == [None, None]
    assert packed.entries == []
