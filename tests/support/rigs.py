"""A camera rig, and the configuration of a dataset."""

import dataclasses

from datagen.data.config import DatasetConfig, square
from datagen.scene.description import CameraRig, WalkPoint

RIG = CameraRig(
    target=(0.1, 0.2, 0.5),
    radius=2.0,
    elevation_deg=(5, 70),
    azimuth_deg=(-60, 150),
    walk=(
        WalkPoint(position=(1, 0, 0.3), target=(0, 0, 0.5)),
        WalkPoint(position=(3, 2, 2), target=(0, 1, 0.5)),
        WalkPoint(position=(0, 4, 0.5), target=(0, 0, 1)),
    ),
)


def config(views: int = 64, seed: int = 0, size: int = 24) -> DatasetConfig:
    return dataclasses.replace(DatasetConfig.even("s", square(size), views), seed=seed)
