"""Presets: the named sizes of a dataset."""

import dataclasses
from dataclasses import dataclass

from datagen.data.config import Resolution, SplitConfig, square


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
