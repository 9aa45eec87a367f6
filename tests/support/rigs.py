"""A camera rig, and the configuration of a dataset."""

from datagen.data.config import DatasetConfig, SplitConfig, square
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
    split = SplitConfig(views=views, spp=4)
    return DatasetConfig(
        scene="s", preset="p", resolution=square(size), train=split, interpolating=split, extrapolating=split, seed=seed
    )
