"""The source of an export: a dataset's views by role, the space that they show, and points of its surfaces."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, UInt8

from datagen.data.cameras import Camera
from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import Dataset, View
from datagen.data.variants import evenly
from datagen.disk.errors import HyalineError
from datagen.quantities import ViewQuantities, quantities
from datagen.terminal.command import track

Role = Literal["train", "val", "test"]
ROLES: tuple[Role, ...] = get_args(Role)

MAX_HELD_OUT = 4
"""Training views that are for validation, as `model train` holds them out."""

MARGIN = 0.01
"""Share by which near and far planes and the scene's box are wider than what is seen."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportView:
    """One view, and what it is for."""

    view: View
    role: Role

    @property
    def name(self) -> str:
        """Unique among all views, such as `extrapolating_0003`: split and number are those of the dataset."""
        return f"{self.view.split}_{self.view.index:04d}"

    @property
    def group(self) -> str:
        """What it is for: train, val, interpolating or extrapolating."""
        return self.view.split if self.role == "test" else self.role

    @property
    def has_picture(self) -> bool:
        """False where a verifier keeps it."""
        return self.view.split not in self.view.dataset.withheld

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """The 8-bit sRGB picture; grey where a verifier keeps it, since most tools open every picture they list."""
        if self.has_picture:
            return self.view.image
        return np.full((self.view.camera.height, self.view.camera.width, 3), 128, np.uint8)

    @property
    def quantities(self) -> ViewQuantities:
        """Depth, normals, masks; computed again each time."""
        return quantities(self.view)


def tracked(views: Sequence[ExportView]) -> Iterator[ExportView]:
    """The views one by one, with progress on stderr."""
    return track(views, label="export", total=len(views))


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """The space that the views show, in metres; the sky is beyond it."""

    near: float
    """Less than the distance of every surface from the camera that sees it, glass above all."""
    far: float
    """More than the distance of every surface that is seen, through straight glass too."""
    low: tuple[float, float, float]
    """Corner of the box around all surfaces that are seen, in world axes."""
    high: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class PointCloud:
    """Points of the true surfaces that training views see first, spread evenly over their pixels."""

    position: Float[np.ndarray, "point 3"]
    """Metres, world axes."""
    normal: Float[np.ndarray, "point 3"]
    """Unit shading normal, towards the view that shows the point."""
    color: UInt8[np.ndarray, "point 3"]
    """sRGB, as that view shows it; for glass, what is seen through it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Source:
    """An opened dataset, and the choices for its export."""

    dataset: Dataset
    num_points: int
    flow: bool
    """Trace refractive flow and attenuation, too, for formats that have a place for them."""

    def __post_init__(self) -> None:
        if self.dataset.parent is not None:
            raise HyalineError(
                f"{self.dataset.root}: is a variant, which has no training views; export the dataset around it, "
                f"{self.dataset.parent.root}"
            )
        if not 1 <= self.num_points <= 10_000_000:
            raise HyalineError(f"points: is {self.num_points}; expected 1 to 10,000,000")

    @functools.cached_property
    def views(self) -> tuple[ExportView, ...]:
        """All views: training ones, those of them held out for validation, then both test splits.

        Where there are fewer than five training views, none is held out, and the first is for validation, too.
        """
        train = self.dataset.views("train")
        if not train:
            raise HyalineError(f"{self.dataset.root}: has no training views; expected at least one to export")
        held_out = evenly(min(MAX_HELD_OUT, len(train) // 5), len(train))
        test = [view for split in TEST_SPLITS for view in self.dataset.views(split)]
        return (
            *(ExportView(view=view, role="train") for view in train if view.index not in held_out),
            *(ExportView(view=train[index], role="val") for index in held_out or [0]),
            *(ExportView(view=view, role="test") for view in test),
        )

    @functools.cached_property
    def pictures(self) -> tuple[ExportView, ...]:
        """The views, each once: one that both trains and validates is here as a training view."""
        first: dict[str, ExportView] = {}
        for item in self.views:
            first.setdefault(item.name, item)
        return tuple(first.values())

    @property
    def lens(self) -> Camera:
        """A camera with the lens that all views share."""
        return self.pictures[0].view.camera

    def of_role(self, role: Role) -> tuple[ExportView, ...]:
        """The views of one role, in order."""
        return tuple(item for item in self.views if item.role == role)

    @functools.cached_property
    def bounds(self) -> Bounds:
        """Reads the layers of every view."""
        depths, positions = [], []
        for item in self.pictures:
            found = item.quantities
            seen = [(found.depth_along_ray, found.position), (found.opaque_depth_along_ray, found.opaque_position)]
            for depth, position in seen:
                there = depth > 0
                if there.any():
                    depths += [depth[there].min(), depth[there].max()]
                    positions += [position[there].min(axis=0), position[there].max(axis=0)]
        if not depths:
            raise HyalineError(f"{self.dataset.root}: no view shows a surface; expected one")
        low, high = np.min(positions, axis=0).astype(float), np.max(positions, axis=0).astype(float)
        cameras = self.dataset.cameras("train")
        pad = MARGIN * (high - low).max()
        return Bounds(
            # Datasets of format version 1 do not record it; then it is what the pixels' centre rays meet.
            near=float((1 - MARGIN) * min(depths)) if cameras.near is None else cameras.near,
            far=float((1 + MARGIN) * max(depths)) if cameras.far is None else cameras.far,
            low=tuple((low - pad).tolist()),
            high=tuple((high + pad).tolist()),
        )

    @functools.cached_property
    def points(self) -> PointCloud:
        """Points from every training view; the same for the same dataset and number."""
        views = self.of_role("train")
        rng = np.random.default_rng(0)
        shares = [(place + 1) * self.num_points // len(views) - place * self.num_points // len(views)
                  for place in range(len(views))]  # fmt: skip
        parts = [_points_of(item, share, rng) for item, share in zip(views, shares, strict=True)]
        positions, normals, colors = (np.concatenate(column) for column in zip(*parts, strict=True))
        return PointCloud(position=positions, normal=normals, color=colors)


def _points_of(
    item: ExportView, count: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, "point 3"], UInt8[np.ndarray, "point 3"]]:
    """Position, normal and colour at pixels that meet a surface, none of them twice."""
    found = item.quantities
    there = np.flatnonzero(~found.background)
    pixels = np.sort(rng.permutation(there)[:count])
    columns = (found.position, found.normal("shading"), item.image)
    position, normal, color = (values.reshape(-1, 3)[pixels] for values in columns)
    return position.astype(np.float64), normal.astype(np.float64), color
