"""The dataset of pane and floor, which needs no Mitsuba (datagen/builder/synthetic.py)."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from datagen.builder.synthetic import HEIGHTS, look_at, quad, shade, synthetic_scene, trace, write_synthetic_dataset
from datagen.data.cameras import Cameras
from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.images import png_bytes

__all__ = ["HEIGHTS", "look_at", "quad", "shade", "synthetic_scene", "trace", "write_synthetic_dataset"]


def pixel_rays(cameras: Cameras, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and unit directions (h, w, 3) of the rays through pixel centres."""
    focal = 0.5 * cameras.width / np.tan(cameras.fov_x / 2)
    x = (np.arange(cameras.width) + 0.5 - cameras.width / 2) / focal
    y = -(np.arange(cameras.height) + 0.5 - cameras.height / 2) / focal
    local = np.stack(np.broadcast_arrays(x[None, :], y[:, None], -1.0), axis=-1)
    matrix = cameras.world_from_camera[view]
    directions = local @ matrix[:3, :3].T
    return matrix[:3, 3], directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def write_predictions(
    dataset: Dataset, run: Path, change: Callable[[np.ndarray], np.ndarray], *, splits: Sequence[Split] = TEST_SPLITS
) -> None:
    """A method's pictures of a dataset: the true ones, changed."""
    for split in splits:
        (run / "predictions" / split).mkdir(parents=True)
        for view in dataset.views(split):
            picture = png_bytes(change(view.image))
            (run / "predictions" / split / f"{view.index:04d}.png").write_bytes(picture)
