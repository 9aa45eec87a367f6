"""Presets: the named sizes of a dataset."""

import dataclasses
from dataclasses import dataclass

from datagen.data.config import DatasetConfig, Resolution, SplitConfig, square
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


def resize(
    preset: Preset,
    *,
    resolution: Resolution | None,
    views: int | None,
    test_views: int | None,
    spp: int | None,
    test_spp: int | None,
) -> Preset:
    """The preset with single values replaced where they are given."""

    def replaced(split: SplitConfig, views: int | None, spp: int | None) -> SplitConfig:
        return SplitConfig(
            views=split.views if views is None else views,
            spp=split.spp if spp is None else spp,
        )

    return dataclasses.replace(
        preset,
        resolution=preset.resolution if resolution is None else resolution,
        train=replaced(preset.train, views, spp),
        interpolating=replaced(preset.interpolating, test_views, test_spp),
        extrapolating=replaced(preset.extrapolating, test_views, test_spp),
    )


def configure(
    preset: str,
    *,
    resolution: Resolution | None = None,
    views: int | None = None,
    test_views: int | None = None,
    spp: int | None = None,
    test_spp: int | None = None,
    ceiling_db: float | None = None,
    max_depth: int = 24,
    seed: int = 0,
) -> DatasetConfig:
    """The configuration of a new dataset; `fit_to_scene` completes it when the scene is known."""
    size = resize(
        PRESETS[choose("preset", preset, PRESETS)],
        resolution=resolution,
        views=views,
        test_views=test_views,
        spp=spp,
        test_spp=test_spp,
    )
    return DatasetConfig(
        scene="scene",
        preset=preset,
        resolution=size.resolution,
        train=size.train,
        interpolating=size.interpolating,
        extrapolating=size.extrapolating,
        ceiling_db=ceiling_db,
        max_depth=max_depth,
        seed=seed,
    )


def fit_to_scene(config: DatasetConfig, scene: Scene, *, keep_resolution: bool, keep_views: bool) -> DatasetConfig:
    """The configuration with the scene's name, and with the resolution and views of its cameras if it lists them.

    Args:
        keep_resolution: somebody chose the resolution.
        keep_views: somebody chose the numbers of views.
    """
    config = dataclasses.replace(config, scene=scene.name)
    if not keep_resolution:
        config = with_listed_shape(config, scene.cameras)
    return config if keep_views else with_listed_views(config, scene.cameras)
