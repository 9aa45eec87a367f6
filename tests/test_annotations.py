"""Tests that every test checks the annotations of what it calls: shapes, dtypes, and the fields of records."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError
from support.checked import unchecked

from datagen.data.cameras import Camera, look_at
from eval.score.metrics import psnr

PICTURE = np.zeros((4, 6, 3), np.uint8)


def test_a_wrong_shape_is_refused() -> None:
    assert psnr(PICTURE, PICTURE) == np.inf
    with pytest.raises(TypeCheckError, match="pred"):
        psnr(PICTURE[..., 0], PICTURE[..., 0])
    with pytest.raises(TypeCheckError, match="target"):
        psnr(PICTURE, PICTURE[:-1])


def test_a_wrong_dtype_is_refused() -> None:
    with pytest.raises(TypeCheckError, match="target"):
        look_at(np.ones(3), np.zeros(3, np.int64))


def test_a_field_of_another_shape_is_refused() -> None:
    with pytest.raises(TypeCheckError, match="world_from_camera"):
        Camera(world_from_camera=np.eye(3), fov_x=0.5, width=2, height=2)


def test_what_is_meant_to_be_wrong_can_be_passed_in_a_block() -> None:
    with unchecked():
        assert look_at(np.ones(3), np.zeros(3, np.int64)).shape == (4, 4)
    with pytest.raises(TypeCheckError):
        look_at(np.ones(3), np.zeros(3, np.int64))
