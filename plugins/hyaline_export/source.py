"""What exports are made of: a dataset's views by role, points of its surfaces, and what encodes them for tools."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from datagen.data.cameras import Camera
from datagen.data.dataset import Dataset, View
from datagen.data.images import png_bytes
from datagen.data.variants import evenly
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.quantities import ViewQuantities, quantities
from datagen.terminal.command import track

Role = Literal["train", "val", "test"]
ROLES: tuple[Role, ...] = get_args(Role)

MAX_HELD_OUT = 4
"""Training views that are for validation: as `model train` holds them out, but at least one."""


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
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """The 8-bit sRGB picture; grey where a verifier keeps it, since most tools open every picture they list."""
        if self.view.split in self.view.dataset.withheld:
            return np.full((self.view.camera.height, self.view.camera.width, 3), 128, np.uint8)
        return self.view.image

    @property
    def quantities(self) -> ViewQuantities:
        """Depth, normals, masks; computed again each time."""
        return quantities(self.view)


def tracked(views: Sequence[ExportView]) -> Iterator[ExportView]:
    """The views one by one, with progress on stderr."""
    return track(views, label="export", total=len(views))


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

    def __post_init__(self) -> None:
        if not 1 <= self.num_points <= 10_000_000:
            raise HyalineError(f"points: is {self.num_points}; expected 1 to 10,000,000")

    @functools.cached_property
    def views(self) -> tuple[ExportView, ...]:
        """All views: training ones, those of them held out for validation, then the test splits."""
        train = self.dataset.views("train") if "train" in self.dataset.splits else []
        held_out = evenly(max(len(train) > 1, min(MAX_HELD_OUT, len(train) // 5)), len(train))
        test = [view for split in self.dataset.splits if split != "train" for view in self.dataset.views(split)]
        return (
            *(ExportView(view=view, role="train") for view in train if view.index not in held_out),
            *(ExportView(view=train[index], role="val") for index in held_out),
            *(ExportView(view=view, role="test") for view in test),
        )

    @property
    def lens(self) -> Camera:
        """A camera with the lens that all views share."""
        return self.views[0].view.camera

    def of_role(self, role: Role) -> tuple[ExportView, ...]:
        """The views of one role, in order."""
        return tuple(item for item in self.views if item.role == role)

    @property
    def near_far(self) -> dict[str, Json]:
        """Between which distances surfaces are, metres along the ray; datasets of format version 1 do not say it."""
        cameras = self.dataset.cameras("train")
        return {} if cameras.near is None else {"near": cameras.near, "far": cameras.far}

    @property
    def world(self) -> dict[str, Json]:
        """What a file says of the world that its views show, and its licence."""
        return {"license": self.dataset.license, **self.near_far}

    @functools.cached_property
    def points(self) -> PointCloud:
        """Points from every training view; the same for the same dataset and number."""
        views = self.of_role("train")
        rng = np.random.default_rng(0)
        shares = np.diff(np.arange(len(views) + 1) * self.num_points // len(views)).tolist()
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


# Encoders that several formats share


def rgb_png(item: ExportView) -> bytes:
    """The 8-bit sRGB picture, without alpha."""
    return png_bytes(item.image)


def rgba_png(item: ExportView) -> bytes:
    """The picture with an alpha of 255 everywhere: whatever a tool puts behind it, it shows what the dataset does.

    The sky and what is seen through glass belong to the picture: none of it may be replaced by a background.
    """
    image = item.image
    return png_bytes(np.concatenate([image, np.full_like(image[..., :1], 255)], axis=-1))


def depth_png(depth: Float32[np.ndarray, "h w"]) -> bytes:
    """16-bit PNG in millimetres, rounded; 0 where there is no surface, or one beyond 65.535 m."""
    millimetres = np.rint(depth.astype(np.float64) * 1000)
    return png_bytes(np.where(millimetres > np.iinfo(np.uint16).max, 0, millimetres).astype(np.uint16))


def mask_png(mask: Bool[np.ndarray, "h w"]) -> bytes:
    """8-bit grey PNG: 255 where the mask is True, 0 elsewhere."""
    return png_bytes(np.where(mask, 255, 0).astype(np.uint8))


def ply_points(points: PointCloud) -> bytes:
    """A binary PLY of points with normals and colours, as Gaussian splatting and nerfstudio start from."""
    layout = [("position", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)]
    rows = np.empty(len(points.position), np.dtype(layout))
    rows["position"], rows["normal"], rows["color"] = points.position, points.normal, points.color
    names = [*(f"float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")), "uchar red", "uchar green", "uchar blue"]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines = [*header, *(f"property {name}" for name in names), "end_header", ""]
    return "\n".join(lines).encode() + rows.tobytes()


MAX_SHIFT = 0.05
"""Pixels by which a principal point may miss the picture's middle and still be taken for it."""


def check_centered(camera: Camera, form: str) -> None:
    """Refuses cameras that readers of a format would take for others: they know the angle of the lens alone."""
    column, row = camera.principal_point
    if max(abs(column - camera.width / 2), abs(row - camera.height / 2)) > MAX_SHIFT:
        raise HyalineError(
            f"--format {form}: its readers take the picture's middle for the principal point, which is {column:g}, "
            f"{row:g} here; export as nerfstudio or colmap"
        )


def frame(item: ExportView, file_path: str, **more: Json) -> dict[str, Json]:
    """One view: its picture and its world_from_camera (OpenGL)."""
    matrix = np.asarray(item.view.camera.world_from_camera, np.float64)
    return {"file_path": file_path, "transform_matrix": matrix.tolist(), **more}
