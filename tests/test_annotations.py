"""Tests that every test checks the annotations of what it calls: shapes, dtypes, and the fields of records."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError
from support.checked import unchecked

from datagen.data.cameras import Camera
from eval.score.metrics import psnr

PICTURE = np.zeros((4, 6, 3), np.uint8)


def test_another_shape_or_dtype_is_refused_unless_it_is_meant() -> None:
    with pytest.raises(TypeCheckError, match="pred"):
        psnr(PICTURE[..., 0], PICTURE[..., 0])
    with pytest.raises(TypeCheckError, match="target"):
        psnr(PICTURE, PICTURE[:-1])
    with pytest.raises(TypeCheckError, match="world_from_camera"):
        Camera(world_from_camera=np.eye(3), fov_x=0.5, width=2, height=2)
    wide = PICTURE.astype(np.int64)
    with unchecked():
        assert psnr(wide, PICTURE) == np.inf
    with pytest.raises(TypeCheckError, match="pred"):
        psnr(wide, PICTURE)
