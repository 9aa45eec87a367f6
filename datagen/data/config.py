"""How a dataset is configured: its splits, their sizes and resolution, and how they are rendered."""

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from datagen.disk.errors import HyalineError
from datagen.disk.names import check_name
from datagen.disk.records import Json, entry, from_json, shown

MAX_SIDE = 8192
"""Pixels; a larger number is probably a typo."""


@dataclass(frozen=True, kw_only=True)
class Resolution:
    """Width and height of pictures in pixels, which are square."""

    width: int
    height: int

    def __post_init__(self) -> None:
        for value in (self.width, self.height):
            if not 1 <= value <= MAX_SIDE:
                raise HyalineError(f"resolution: is {value}; expected 1 to {MAX_SIDE} pixels")

    def __str__(self) -> str:
        return f"{self.width} x {self.height}"

    @property
    def pixels(self) -> int:
        """Pixels in one picture."""
        return self.width * self.height

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, the order of an array's axes."""
        return self.height, self.width

    @property
    def shorter(self) -> int:
        """The shorter side."""
        return min(self.width, self.height)

    @property
    def mean_side(self) -> int:
        """Side of the square with the same area, rounded down; the default resolution of textures."""
        return math.isqrt(self.pixels)

    @property
    def is_power_of_two_square(self) -> bool:
        """True for 64 x 64, 128 x 128 and so on."""
        return self.width == self.height and self.width & (self.width - 1) == 0

    def times(self, scale: int) -> Self:
        """The resolution scaled by an integer."""
        return type(self)(width=scale * self.width, height=scale * self.height)


def square(side: int) -> Resolution:
    """The resolution of square pictures."""
    return Resolution(width=side, height=side)


def parse_resolution(text: str) -> Resolution:
    """The resolution that a user wrote: `256` is 256 x 256 pixels, `320x240` is 320 wide and 240 high."""
    found = re.fullmatch(r"(-?[0-9]{1,9})(?: ?x ?(-?[0-9]{1,9}))?", text.strip())
    if found is None:
        raise HyalineError(f"resolution: is {shown(text)}; expected a width and height such as 320x240, or one number")
    width, height = found[1], found[2] or found[1]
    return Resolution(width=int(width), height=int(height))


Split = Literal[
    "train", "interpolating", "extrapolating", "extrapolating-10deg", "extrapolating-20deg", "extrapolating-40deg"
]
SPLITS: tuple[Split, ...] = ("train", "interpolating", "extrapolating")
"""The splits of every dataset."""
TEST_SPLITS: tuple[Split, ...] = ("interpolating", "extrapolating")
ANGLE_SPLITS: dict[Split, float] = {"extrapolating-10deg": 10, "extrapolating-20deg": 20, "extrapolating-40deg": 40}
"""The splits of the variant `angles`: degrees outside the directions that training cameras cover."""

SPLIT_ORDER: dict[Split, int] = {split: place for place, split in enumerate((*SPLITS, *ANGLE_SPLITS))}

DATASET_VERSION = 3

MAX_VIEWS, MAX_SPP, MAX_DEPTH = 10_000, 1 << 20, 1000
"""Upper limits on views, samples and path depth; larger values are probably typos."""


def check_spp(spp: int) -> None:
    """Raises a HyalineError if the number of samples per pixel is too small or too large."""
    if not 2 <= spp <= MAX_SPP:
        raise HyalineError(f"spp: is {spp}; expected 2 to {MAX_SPP:,} samples per pixel")


@dataclass(frozen=True, kw_only=True)
class SplitConfig:
    """How one split is rendered."""

    views: int
    spp: int | None
    """Samples per pixel, both halves together; with a noise ceiling, the number to start from. None: imported."""

    def __post_init__(self) -> None:
        if not 0 <= self.views <= MAX_VIEWS:
            raise HyalineError(f"views: are {self.views}; expected at least 1, at most {MAX_VIEWS:,}")
        if self.spp is not None:
            check_spp(self.spp)

    def __str__(self) -> str:
        return f"{self.views} views of {self.spp} samples per pixel"

    @property
    def samples(self) -> int:
        """Samples of one pixel, summed over the views."""
        return self.views * (self.spp or 0)


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """What `datagen build` makes; two builds with equal configurations give equal bytes."""

    scene: str
    preset: str
    resolution: Resolution
    train: SplitConfig
    interpolating: SplitConfig
    extrapolating: SplitConfig
    ceiling_db: float | None = None
    """Render each test view until its noise ceiling reaches this; None renders a fixed number of samples."""
    max_depth: int = 24
    """Longest light path in segments."""
    seed: int = 0

    def __post_init__(self) -> None:
        check_name(self.scene, where="scene name")
        for split in TEST_SPLITS:
            if self.split(split).views < 1:
                raise HyalineError(f"{split}: has {self.split(split).views} views; expected at least 1")
        if not 2 <= self.max_depth <= MAX_DEPTH:
            raise HyalineError(f"max_depth: is {self.max_depth}; expected 2 to {MAX_DEPTH} (12 or more for glass)")
        if not 0 <= self.seed < 2**63:
            raise HyalineError(f"seed: is {self.seed}; expected 0 or more, and at most 63 bits")
        if self.ceiling_db is not None and not 10 <= self.ceiling_db <= 50:
            raise HyalineError(f"ceiling_db: is {self.ceiling_db}; expected 10 to 50 dB")

    @classmethod
    def even(cls, scene: str, resolution: Resolution, views: int, *, spp: int = 4) -> "DatasetConfig":
        """As many views in each split: for pictures and cameras that no preset describes."""
        split = SplitConfig(views=views, spp=spp)
        return cls(
            scene=scene,
            preset="even",
            resolution=resolution,
            train=split,
            interpolating=split,
            extrapolating=split,
        )

    def split(self, split: Split) -> SplitConfig:
        """The size of a split; splits by angle have the size of `extrapolating`."""
        sizes = {"train": self.train, "interpolating": self.interpolating, "extrapolating": self.extrapolating}
        return sizes["extrapolating" if split in ANGLE_SPLITS else split]


def describe_views(views: Iterable[tuple[Split, int]]) -> str:
    """Names views, such as `train 3-7, 12; extrapolating 0`."""
    by_split: dict[str, list[int]] = {}
    for split, view in sorted(views, key=lambda item: (SPLIT_ORDER[item[0]], item[1])):
        by_split.setdefault(split, []).append(view)
    parts = []
    for split, numbers in by_split.items():
        starts = [view for view in numbers if view - 1 not in numbers]
        ends = [view for view in numbers if view + 1 not in numbers]
        runs = [f"{start}" if start == end else f"{start}-{end}" for start, end in zip(starts, ends, strict=True)]
        parts.append(f"{split} {', '.join(runs)}")
    return "; ".join(parts)


def config_of(head: Mapping[str, Json], path: Path) -> DatasetConfig:
    """The configuration in a dataset's head."""
    version = head.get("version")
    if version != DATASET_VERSION:
        again = "build or import the dataset again in another folder" if version in (1, 2) else "update hyaline"
        raise HyalineError(f"{path}: format version {shown(version)}; this program reads {DATASET_VERSION}, {again}")
    return from_json(DatasetConfig, entry(head, "config", where=path), where=f"{path}: config")


def config_difference(old: DatasetConfig, new: DatasetConfig) -> str | None:
    """The first value that differs between two configurations, as `seed is 0 there and 3 here`; None when equal."""
    for item in dataclasses.fields(old):
        before, after = getattr(old, item.name), getattr(new, item.name)
        if before != after:
            return f"{item.name} is {before} there and {after} here"
    return None
