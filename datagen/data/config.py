"""Records in a dataset's head and beside its views: configuration, variant, import, view, licence."""

import dataclasses
import math
import re
from dataclasses import dataclass
from typing import Literal, Self

from datagen.disk.errors import HyalineError, shown
from datagen.disk.storage import check_name, check_relative

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

DATASET_VERSION = 4

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
    max_depth: int = 100
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
            scene=scene, preset="even", resolution=resolution, train=split, interpolating=split, extrapolating=split
        )

    def split(self, split: Split) -> SplitConfig:
        """The size of a split; splits by angle have the size of `extrapolating`."""
        sizes = {"train": self.train, "interpolating": self.interpolating, "extrapolating": self.extrapolating}
        return sizes["extrapolating" if split in ANGLE_SPLITS else split]


def config_difference(old: DatasetConfig, new: DatasetConfig) -> str | None:
    """The first value that differs between two configurations, as `seed is 0 there and 3 here`; None when equal."""
    names = (item.name for item in dataclasses.fields(old))
    pairs = ((name, getattr(old, name), getattr(new, name)) for name in names)
    return next((f"{name} is {old} there and {new} here" for name, old, new in pairs if old != new), None)


ROUNDING_MSE = 2 / 12 / 255**2
"""What rounding two pictures to 8 bits adds to their mean squared difference, unless both are nearly free of noise."""


@dataclass(frozen=True, kw_only=True)
class ViewRecord:
    """One view: how it was made, and its files. Written last. Fields of the renderer are None for imported views."""

    dataset: str
    """Seal of the view's dataset."""
    split: Split
    view: int
    seed: int | None = None
    spp: int | None = None
    """Samples per pixel that were drawn, both halves together."""
    noise_mse: float | None = None
    """Estimated mean squared error of the clipped sRGB image against its limit for infinitely many samples."""
    variant: str | None = None
    """What rendered it: a variant of Mitsuba, or another renderer by name."""
    files: dict[str, str]
    """SHA-256 by path, relative to the dataset."""

    @property
    def ceiling_db(self) -> float | None:
        """The PSNR in dB that noise and 8 bits would leave a perfect method; None if unknown."""
        return None if self.noise_mse is None else -10 * math.log10(self.noise_mse + ROUNDING_MSE)


@dataclass(frozen=True, kw_only=True)
class SceneEdit:
    """How the scene of a variant differs from that of the dataset around it."""

    edits: tuple[str, ...]
    """The edits in order, as `datagen.scene.edits.parse_edit` reads them."""
    changed: tuple[str, ...]
    """Names of the objects that were removed, moved, copied or given another material."""
    copies: dict[str, str]
    """The original of each copy: no renderer was trained on the copies, but on these."""

    def __post_init__(self) -> None:
        for name in (*self.changed, *self.copies, *self.copies.values()):
            check_name(name, where="object name")


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A dataset inside another one."""

    of: str
    """Seal of its parent, the dataset around it."""
    splits: tuple[Split, ...]
    """Its splits."""
    edit: SceneEdit | None = None
    """None: it has the parent's scene, meshes and proxies. Otherwise it has the parent's test cameras."""


@dataclass(frozen=True, kw_only=True)
class Imported:
    """Where the pictures come from if they were not rendered here.

    Their noise, radiance and light are unknown. Without imported meshes, there is no scene.
    """

    layout: str
    """Layout of the source folder: refref, openmaterial, blender, nerfstudio or capture."""
    source: str
    """Name of the source folder."""
    source_sha256: str
    """Hash of the pictures and everything else that was read."""
    has_masks: bool
    has_depth: bool
    has_objects: bool = False
    """There is a mask for each object of glass."""
    remarks: tuple[str, ...] = ()
    """Decisions and omissions, a line each."""

    @property
    def endings(self) -> tuple[str, ...]:
        """Endings of the files of a view."""
        masks, depth = (".mask.png",) * self.has_masks, (".depth.npy",) * self.has_depth
        return (".png", *masks, *depth, *(".objects.png",) * self.has_objects)


RENDERED = (".png", ".exr")
"""Endings of the files of a rendered view."""


@dataclass(frozen=True, kw_only=True)
class DatasetObject:
    """One object as users of the dataset see it; its id is 1 + its place in `Dataset.objects`."""

    name: str
    is_glass: bool


@dataclass(frozen=True, kw_only=True)
class Head:
    """The content of dataset.json."""

    version: int
    config: DatasetConfig
    objects: tuple[DatasetObject, ...]
    files: dict[str, str]
    """SHA-256 of the files of scene and cameras, by path relative to the dataset."""
    variant: Variant | None = None
    imported: Imported | None = None
    license: str | None = None

    def __post_init__(self) -> None:
        for item in self.objects:
            check_name(item.name, where="object name")
        for file in self.files:
            check_relative(file, where="files")

    @property
    def splits(self) -> tuple[Split, ...]:
        return SPLITS if self.variant is None else self.variant.splits

    @property
    def endings(self) -> tuple[str, ...]:
        """Endings of the files of each view."""
        return RENDERED if self.imported is None else self.imported.endings


OWN_LICENSE = "CC0-1.0"
"""SPDX name of the licence of built-in and random scenes, which code generates, and of pictures of them. CC0, because
pictures end up in batches, crops and merged sets that cannot carry attributions."""

MAX_LICENSE_LENGTH = 500
"""Characters of a foreign file's licence that are kept."""


def unknown_license(source: str) -> str:
    """The licence of data that states none: whom to ask."""
    return f"unknown; ask the author of {source}"


def license_line(*parts: object) -> str | None:
    """A foreign file's licence in one line; None if none of the parts is a text."""
    lines = (" ".join(part.split()) for part in parts if isinstance(part, str))
    return "; ".join(dict.fromkeys(filter(None, lines)))[:MAX_LICENSE_LENGTH] or None
