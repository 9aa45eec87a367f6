"""Cameras given one by one, for scenes that bring their own."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.disk.errors import HyalineError
from datagen.scene.values import Vector, as_vector

Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]

MAX_SKEW = 1e-3
"""By which a rotation's axes may miss being perpendicular and of unit length."""

LEAST_GAP_DEG = 60.0
"""Between neighbouring cameras on a circle: something may stand where so much of it is empty."""


@dataclass(frozen=True, kw_only=True)
class CameraList:
    """The cameras of each split, instead of a rig that places them; all have the same lens."""

    train: tuple[Matrix, ...]
    """world_from_camera of each view, row by row: metres, OpenGL convention (+x right, +y up, looks along -z)."""
    interpolating: tuple[Matrix, ...]
    """Of test views among the training cameras."""
    extrapolating: tuple[Matrix, ...]
    """Of test views away from the training cameras."""
    fov_deg: float = 40.0
    """Horizontal field of view."""

    def __post_init__(self) -> None:
        if not 0 < self.fov_deg < 170:
            raise HyalineError(f"camera fov_deg: is {self.fov_deg}; expected 0 to 170")
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
    return CameraList(
        train=rows["train"],
        interpolating=rows["interpolating"],
        extrapolating=rows["extrapolating"],
        fov_deg=math.degrees(cameras["train"].fov_x),
    )


def matrix_rows(matrix: Float[np.ndarray, "4 4"]) -> Matrix:
    """A matrix row by row."""
    a, b, c, d = ((float(x), float(y), float(z), float(w)) for x, y, z, w in matrix)
    return a, b, c, d
