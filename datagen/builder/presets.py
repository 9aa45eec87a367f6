"""Presets: the named sizes of a dataset."""

import dataclasses

from datagen.builder.choices import SizeChoices
from datagen.data.config import DatasetConfig, SplitConfig, parse_resolution, square
from datagen.scene.description import Scene
from datagen.scene.rig import with_listed_shape, with_listed_views
from datagen.terminal.command import choose


def _preset(name: str, side: int, train: tuple[int, int], test: tuple[int, int]) -> DatasetConfig:
    split = SplitConfig(views=test[0], spp=test[1])
    return DatasetConfig(
        scene="scene",
        preset=name,
        resolution=square(side),
        train=SplitConfig(views=train[0], spp=train[1]),
        interpolating=split,
        extrapolating=split,
    )


PRESETS: dict[str, DatasetConfig] = {
    "tiny": _preset("tiny", 32, train=(8, 16), test=(3, 64)),  # Tests: seconds.
    "small": _preset("small", 64, train=(60, 64), test=(8, 256)),  # Many scenes: a minute on two cores.
    "demo": _preset("demo", 128, train=(100, 64), test=(12, 512)),  # A first look: minutes.
    "standard": _preset("standard", 256, train=(200, 64), test=(20, 512)),  # Comparing methods: half an hour.
    "paper": _preset("paper", 512, train=(1000, 64), test=(40, 512)),  # The paper's size: a night.
}
"""Samples per pixel are powers of two, as Sobol's sequence likes."""


def configure(preset: str, size: SizeChoices, *, seed: int) -> DatasetConfig:
    """The configuration of a new dataset; `fit_to_scene` completes it when the scene is known."""
    usual = PRESETS[choose("preset", preset, PRESETS)]
    test = _given(usual.interpolating, views=size.test_views, spp=size.test_spp)
    return dataclasses.replace(
        usual,
        train=_given(usual.train, views=size.views, spp=size.spp),
        interpolating=test,
        extrapolating=test,
        resolution=usual.resolution if size.resolution is None else parse_resolution(str(size.resolution)),
        ceiling_db=size.ceiling,
        max_depth=size.max_depth,
        seed=seed,
    )


def _given(split: SplitConfig, **values: int | None) -> SplitConfig:
    return dataclasses.replace(split, **{name: value for name, value in values.items() if value is not None})


def fit_to_scene(config: DatasetConfig, scene: Scene, size: SizeChoices) -> DatasetConfig:
    """The configuration with the scene's name; what `size` leaves open is as in the scene, if it lists its cameras."""
    config = dataclasses.replace(config, scene=scene.name)
    if size.resolution is None:
        config = with_listed_shape(config, scene.cameras)
    has_views = size.views is not None or size.test_views is not None
    return config if has_views else with_listed_views(config, scene.cameras)
