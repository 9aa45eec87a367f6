"""Cameras given one by one, for scenes that bring their own."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Cameras
from datagen.data.config import Resolution, Split
from datagen.disk.errors import HyalineError
from datagen.scene.values import Vector, as_vector

Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]

MAX_SKEW = 1e-3
"""By which a rotation's axes may miss being perpendicular and of unit length."""

MAX_SHIFT = 4
"""Pictures by which a principal point may be away from the middle: what is beyond has a slip in it."""

LEAST_GAP_DEG = 60.0
"""Between neighbouring cameras on a circle: something may stand where so much of it is empty."""


DEFAULT_FOV_DEG = 40.0


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """The lens of listed cameras, in pixels of a picture; a dataset of another resolution scales it."""

    fl_x: float
    """Focal length."""
    fl_y: float
    """The same as fl_x: pixels are square."""
    cx: float
    """Column of the principal point, from the picture's left border."""
    cy: float
    """Row of the principal point, from the picture's upper border."""
    w: int
    """Width of the picture."""
    h: int
    """Height of the picture."""

    def __post_init__(self) -> None:
        if self.w < 1 or self.h < 1:
            raise HyalineError(f"camera intrinsics: are of {self.w} x {self.h} pixels; expected at least 1 x 1")
        if not (self.fl_x > 0 and math.isclose(self.fl_x, self.fl_y, rel_tol=1e-4)):
            raise HyalineError(
                f"camera intrinsics: fl_x and fl_y are {self.fl_x:g} and {self.fl_y:g}; expected equal focal lengths "
                "above 0, as pixels are square"
            )
        if not 0 < math.degrees(self.fov_x) < 170:
            raise HyalineError(f"camera intrinsics: fl_x is {self.fl_x:g}; expected a lens of less than 170 degrees")
        if max(abs(self.cx - self.w / 2) / self.w, abs(self.cy - self.h / 2) / self.h) > MAX_SHIFT:
            raise HyalineError(
                f"camera intrinsics: cx and cy are {self.cx:g} and {self.cy:g}; expected pixels, at most {MAX_SHIFT} "
                f"pictures of {self.w} x {self.h} away from the middle"
            )

    @property
    def fov_x(self) -> float:
        """2 atan(w / 2 / fl_x) in radians."""
        return 2 * math.atan2(0.5 * self.w, self.fl_x)

    def fitting(self, pixels: int) -> Resolution:
        """The resolution of pictures of the same shape with about so many pixels."""
        width = max(1, round(self.w * math.sqrt(pixels / (self.w * self.h))))
        return Resolution(width=width, height=max(1, round(self.h * width / self.w)))

    def center_in(self, resolution: Resolution) -> tuple[float, float] | None:
        """Column and row of the principal point in pictures of a resolution; None where that is the middle.

        Raises:
            HyalineError: pictures of another shape.
        """
        scale = resolution.width / self.w
        if abs(resolution.height - scale * self.h) > 0.5 + 1e-9:
            raise HyalineError(
                f"resolution: is {resolution}, and the scene's intrinsics are of {self.w} x {self.h} pixels; expected "
                f"that shape, such as {self.fitting(resolution.pixels)}"
            )
        center = self.cx * scale, self.cy * scale
        return None if center == (resolution.width / 2, resolution.height / 2) else center


@dataclass(frozen=True, kw_only=True)
class CameraList:
    """The cameras of each split, instead of a rig that places them; all have the same lens."""

    train: tuple[Matrix, ...]
    """world_from_camera of each view, row by row: metres, OpenGL convention (+x right, +y up, looks along -z)."""
    interpolating: tuple[Matrix, ...]
    """Of test views among the training cameras."""
    extrapolating: tuple[Matrix, ...]
    """Of test views away from the training cameras."""
    fov_deg: float = DEFAULT_FOV_DEG
    """Horizontal field of view, where there are no intrinsics."""
    intrinsics: Intrinsics | None = None
    """The lens in pixels, where its principal point is not in the picture's middle or pictures are not square."""

    def __post_init__(self) -> None:
        if not 0 < self.fov_deg < 170:
            raise HyalineError(f"camera fov_deg: is {self.fov_deg}; expected 0 to 170")
        if self.intrinsics is not None and self.fov_deg != DEFAULT_FOV_DEG:
            raise HyalineError(f"camera fov_deg: is {self.fov_deg}, and there are intrinsics, too; leave one out")
        for split, matrices in self.poses().items():
            if not len(matrices):
                raise HyalineError(f"cameras {split}: there are none; expected at least one matrix")
            rotation = matrices[:, :3, :3]
            skew = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
            is_good = (skew < MAX_SKEW) & (np.linalg.det(rotation) > 0) & (matrices[:, 3] == [0, 0, 0, 1]).all(axis=1)
            if not is_good.all():
                raise HyalineError(
                    f"cameras {split}[{int(np.argmin(is_good))}]: is no rotation and place; expected world_from_camera "
                    "with perpendicular axes of length 1, right-handed, and a last row of 0, 0, 0, 1"
                )

    def poses(self) -> dict[str, Float[np.ndarray, "view 4 4"]]:
        """world_from_camera by split."""
        listed = {"train": self.train, "interpolating": self.interpolating, "extrapolating": self.extrapolating}
        return {split: np.array(matrices, np.float64).reshape(-1, 4, 4) for split, matrices in listed.items()}

    @property
    def target(self) -> Vector:
        """The point that the training cameras look at: nearest to all of their axes."""
        place, ahead = self._axes()
        across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
        # Of cameras that all look the same way every point along it is as near: then it is the one 1 m ahead.
        tie = 1e-6 * np.eye(3)
        sums = across.sum(axis=0) + tie, np.einsum("vij,vj->i", across, place) + tie @ (place + ahead).mean(axis=0)
        return as_vector(np.linalg.solve(*sums))

    @property
    def radius(self) -> float:
        """Metres from the training cameras to their target; half of them are nearer."""
        return float(np.median(np.linalg.norm(self._axes()[0] - self.target, axis=1)))

    @property
    def elevation_deg(self) -> tuple[float, float]:
        """Lowest and highest training camera above the target's horizon."""
        elevation = np.degrees(np.arcsin(self._directions()[:, 2]))
        return float(elevation.min()), float(elevation.max())

    @property
    def azimuth_deg(self) -> tuple[float, float]:
        """First and last azimuth of training cameras around the target; all but the widest gap between two of them."""
        directions = self._directions()
        azimuth = np.sort(np.degrees(np.arctan2(directions[:, 1], directions[:, 0])))
        gaps = np.diff(azimuth, append=azimuth[0] + 360)
        widest = int(np.argmax(gaps))
        if gaps[widest] < LEAST_GAP_DEG:
            return 0.0, 360.0
        first = float(azimuth[(widest + 1) % len(azimuth)])
        return first, first + 360 - float(gaps[widest])

    def _directions(self) -> Float[np.ndarray, "view 3"]:
        """From the target to the training cameras, of unit length."""
        away = self._axes()[0] - self.target
        return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)

    def _axes(self) -> tuple[Float[np.ndarray, "view 3"], Float[np.ndarray, "view 3"]]:
        matrices = self.poses()["train"]
        return matrices[:, :3, 3], -matrices[:, :3, 2]


def list_cameras(cameras: Mapping[Split, Cameras]) -> CameraList:
    """The cameras of all splits as a scene lists them."""
    rows = {split: tuple(map(matrix_rows, item.world_from_camera)) for split, item in cameras.items()}
    lens = cameras["train"]
    fov_deg, intrinsics = math.degrees(lens.fov_x), None
    if lens.center is not None:
        focal = 0.5 * lens.width / math.tan(0.5 * lens.fov_x)
        (column, row), fov_deg = lens.center, DEFAULT_FOV_DEG
        intrinsics = Intrinsics(fl_x=focal, fl_y=focal, cx=column, cy=row, w=lens.width, h=lens.height)
    return CameraList(
        train=rows["train"],
        interpolating=rows["interpolating"],
        extrapolating=rows["extrapolating"],
        fov_deg=fov_deg,
        intrinsics=intrinsics,
    )


def matrix_rows(matrix: Float[np.ndarray, "4 4"]) -> Matrix:
    """A matrix row by row."""
    a, b, c, d = ((float(x), float(y), float(z), float(w)) for x, y, z, w in matrix)
    return a, b, c, d
