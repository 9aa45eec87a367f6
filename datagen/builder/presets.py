"""Presets: the named sizes of a dataset."""

import dataclasses
from dataclasses import dataclass

from datagen.builder.choices import SizeChoices
from datagen.data.config import DatasetConfig, Resolution, SplitConfig, parse_resolution, square
from datagen.scene.description import Scene
from datagen.scene.rig import with_listed_shape, with_listed_views
from datagen.terminal.command import choose


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Everything about a dataset's size; samples per pixel are powers of two, as Sobol's sequence likes."""

    resolution: Resolution
    train: SplitConfig
    interpolating: SplitConfig
    extrapolating: SplitConfig
    purpose: str


def _preset(purpose: str, side: int, train: tuple[int, int], test: tuple[int, int]) -> Preset:
    test_split = SplitConfig(views=test[0], spp=test[1])
    return Preset(
        resolution=square(side),
        train=SplitConfig(views=train[0], spp=train[1]),
        interpolating=test_split,
        extrapolating=test_split,
        purpose=purpose,
    )


PRESETS: dict[str, Preset] = {
    "tiny": _preset("tests: seconds", 32, train=(8, 16), test=(3, 64)),
    "small": _preset("many scenes: a minute on two cores", 64, train=(60, 64), test=(8, 256)),
    "demo": _preset("a first look: minutes on two cores", 128, train=(100, 64), test=(12, 512)),
    "standard": _preset("comparing methods: half an hour on two cores", 256, train=(200, 64), test=(20, 512)),
    "paper": _preset("the paper's size: a night on two cores", 512, train=(1000, 64), test=(40, 512)),
}


def configure(preset: str, size: SizeChoices, *, seed: int) -> DatasetConfig:
    """The configuration of a new dataset; `fit_to_scene` completes it when the scene is known."""
    usual = PRESETS[choose("preset", preset, PRESETS)]
    test = _given(usual.interpolating, size.test_views, size.test_spp)
    return DatasetConfig(
        scene="scene",
        preset=preset,
        resolution=usual.resolution if size.resolution is None else parse_resolution(str(size.resolution)),
        train=_given(usual.train, size.views, size.spp),
        interpolating=test,
        extrapolating=test,
        ceiling_db=size.ceiling,
        max_depth=size.max_depth,
        seed=seed,
    )


def _given(usual: SplitConfig, views: int | None, spp: int | None) -> SplitConfig:
    return SplitConfig(views=usual.views if views is None else views, spp=usual.spp if spp is None else spp)


def fit_to_scene(config: DatasetConfig, scene: Scene, size: SizeChoices) -> DatasetConfig:
    """The configuration with the scene's name; what `size` leaves open is as in the scene, if it lists its cameras."""
    config = dataclasses.replace(config, scene=scene.name)
    if size.resolution is None:
        config = with_listed_shape(config, scene.cameras)
    has_views = size.views is not None or size.test_views is not None
    return config if has_views else with_listed_views(config, scene.cameras)
