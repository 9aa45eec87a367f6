"""Cameras given one by one, for scenes that bring their own."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Cameras
from datagen.data.config import SPLITS, Split
from datagen.data.transforms import TRANSFORMS_FILES, parse_transforms, refuse_other_lens, transforms_bytes
from datagen.disk.errors import HyalineError
from datagen.disk.names import find_file
from datagen.disk.records import MAX_JSON_BYTES, read_regular
from datagen.scene.values import Vector, as_vector

LEAST_GAP_DEG = 60.0
"""Degrees between neighbouring cameras on a circle; a wider gap may be there because something is in the way."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraList:
    """The cameras of each split, instead of a rig that places them; all have the same lens."""

    train: Cameras
    interpolating: Cameras
    """Test views among the training cameras."""
    extrapolating: Cameras
    """Test views away from the training cameras."""

    def __post_init__(self) -> None:
        for split in SPLITS:
            if not len(self.of(split)):
                raise HyalineError(f"cameras {split}: there are none; expected at least one")
            refuse_other_lens(self.of(split), self.train, where=f"cameras {split}")

    def of(self, split: Split) -> Cameras:
        """The cameras of one of the splits that every dataset has."""
        return {"train": self.train, "interpolating": self.interpolating, "extrapolating": self.extrapolating}[split]

    @property
    def target(self) -> Vector:
        """The point nearest to the axes of all training cameras."""
        place, ahead = self._axes()
        across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
        # If all cameras look the same way, every point along it is equally near; then it is the point 1 m ahead.
        tie = 1e-6 * np.eye(3)
        sums = across.sum(axis=0) + tie, np.einsum("vij,vj->i", across, place) + tie @ (place + ahead).mean(axis=0)
        return as_vector(np.linalg.solve(*sums))

    @property
    def radius(self) -> float:
        """Median distance of the training cameras from their target in metres."""
        return float(np.median(np.linalg.norm(self._axes()[0] - self.target, axis=1)))

    @property
    def elevation_deg(self) -> tuple[float, float]:
        """Lowest and highest training camera above the target's horizon."""
        elevation = np.degrees(np.arcsin(self._directions()[:, 2]))
        return float(elevation.min()), float(elevation.max())

    @property
    def azimuth_deg(self) -> tuple[float, float]:
        """First and last azimuth of the training cameras around the target, the widest gap left out."""
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
        matrices = self.train.world_from_camera
        return matrices[:, :3, 3], -matrices[:, :3, 2]


def camera_files(cameras: CameraList) -> dict[str, bytes]:
    """The files in which a scene's folder lists its cameras, by name."""
    bare = {split: dataclasses.replace(cameras.of(split), near=None, far=None) for split in SPLITS}
    return {TRANSFORMS_FILES[split]: transforms_bytes(bare[split], split) for split in SPLITS}


def read_camera_list(folder: Path) -> CameraList:
    """The cameras that lie in a scene's folder, or in the dataset around it."""
    # A dataset has them beside scene/; its variants/NAME/, beside whose scene/ are none for training, has its cameras.
    around = [place for place in list(folder.parents)[:3] if (place / "dataset.json").is_file()]
    inside = [place for place in (folder, *around) if (place / TRANSFORMS_FILES["train"]).is_file()]
    if not inside:
        raise HyalineError(
            f"{folder / 'scene.json'}: has no cameras; expected `cameras` there, or "
            f"{', '.join(TRANSFORMS_FILES[split] for split in SPLITS)} beside it"
        )
    paths = {split: find_file(inside[0], TRANSFORMS_FILES[split], where=str(inside[0])) for split in SPLITS}
    return CameraList(
        **{
            split: parse_transforms(read_regular(path, at_most=MAX_JSON_BYTES), where=str(path))
            for split, path in paths.items()
        }
    )
