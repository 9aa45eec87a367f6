"""One transforms file: the lens and the frames that NeRF tools write, each value checked."""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from datagen.data.cameras import Camera, check_camera
from datagen.data.config import MAX_VIEWS
from datagen.data.resolution import Resolution
from datagen.disk.errors import HyalineError
from datagen.disk.names import find_file
from datagen.disk.reading import load_json, open_regular
from datagen.disk.records import shown
from datagen.scene.camera_list import Intrinsics
from datagen.scene.importers.fields import Fields

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
DISTORTED = "have a distorted lens; drawn as pinholes"
NOT_SQUARE = "have pixels that are not square; drawn square, as wide as they are"
ENDINGS = ("", ".png", ".jpg", ".jpeg", ".JPG", ".webp")
TOLERANCE = 1e-3
"""Share by which two focal lengths may differ, and share of the picture by which two principal points may."""


@dataclass(frozen=True, kw_only=True)
class Lens:
    """The lens of all pictures, with square pixels."""

    fov_x: float
    """Radians."""
    size: Resolution
    center: tuple[float, float] | None = None
    """Column and row of the principal point in pixels; None: the pictures' middle."""


class TransformsFile:
    """A transforms file, parsed; what its frames name is found when it is asked for."""

    def __init__(self, root: Path, name: str) -> None:
        self.root = root
        self.path = find_file(root, name, where=str(root))
        self.fields = Fields(load_json(self.path), str(self.path))
        self.frames = self.fields.listed("frames")
        if not 1 <= len(self.frames) <= MAX_VIEWS:
            raise HyalineError(f"{self.path}: has {len(self.frames)} frames; expected 1 to {MAX_VIEWS:,}")

    def lens(self) -> Lens:
        """The lens that all frames share."""
        found = self._lens(self.frames[0])
        for frame in self.frames[1:]:
            if any(key in frame for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", *DISTORTION)):
                refuse_other_lens(self._lens(frame), found, where=frame.where)
        return found

    def _lens(self, frame: Fields) -> Lens:
        number = partial(self._number, frame)
        bent = [key for key in DISTORTION if abs(number(key, 0.0)) > 1e-9]
        if bent or "fisheye" in self.fields.text("camera_model").lower():
            raise HyalineError(
                f"{frame.where}: its lens is distorted ({', '.join(bent) or 'fisheye'}); expected straight lines, "
                "undistort the pictures first (`colmap image_undistorter`)"
            )
        if any(key in fields for key in ("w", "h") for fields in (frame, self.fields)):
            width, height = (round(number(key, 0.0)) for key in ("w", "h"))
        else:
            width, height = picture_size(self.find(frame, "file_path"))
        try:
            size = Resolution(width=width, height=height)
        except HyalineError as error:
            raise HyalineError(f"{frame.where}: {error}") from None
        focal = number("fl_x", 0.0)
        angle = 2 * math.atan(0.5 * width / focal) if focal > 0 else number("camera_angle_x", 0.0)
        if not 0 < angle < math.pi:
            raise HyalineError(f"{frame.where}: has no lens; expected fl_x in pixels or camera_angle_x in radians")
        if focal > 0 and abs(number("fl_y", focal) / focal - 1) > TOLERANCE:
            raise HyalineError(
                f"{frame.where}: has focal lengths {focal:g} and {number('fl_y', focal):g}; expected square pixels, of "
                "equal ones"
            )
        lens = self._intrinsics(frame, angle, width, height)
        center = lens.cx, lens.cy
        return Lens(fov_x=angle, size=size, center=None if center == (width / 2, height / 2) else center)

    def angle(self, frame: Fields) -> tuple[float, Intrinsics | None, list[str]]:
        """A frame's horizontal angle of view in radians, its lens in pixels where told, and what that leaves out."""
        number = partial(self._number, frame)
        width, height, focal = number("w", 2 * number("cx", 0.0)), number("h", 0.0), number("fl_x", 0.0)
        angle = 2 * math.atan(0.5 * width / focal) if focal > 0 and width > 0 else number("camera_angle_x", 0.0)
        if not 0 < angle < math.pi:
            raise HyalineError(
                f"{frame.where}: has no lens; expected camera_angle_x in radians, or fl_x and w in pixels"
            )
        lens = self._intrinsics(frame, angle, width, height) if width >= 1 and height >= 1 else None
        is_bent = any(abs(number(key, 0.0)) > 1e-9 for key in DISTORTION)
        is_square = focal <= 0 or abs(number("fl_y", focal) / focal - 1) <= TOLERANCE
        return angle, lens, [DISTORTED] * is_bent + [NOT_SQUARE] * (not is_square)

    def _number(self, frame: Fields, key: str, default: float) -> float:
        """What a frame says, or else what the file says of all frames."""
        return frame.number(key, self.fields.number(key, default))

    def _intrinsics(self, frame: Fields, angle: float, width: float, height: float) -> Intrinsics:
        pixels = 0.5 * width / math.tan(0.5 * angle)
        cx, cy = self._number(frame, "cx", width / 2), self._number(frame, "cy", height / 2)
        try:
            return Intrinsics(fl_x=pixels, fl_y=pixels, cx=cx, cy=cy, w=round(width), h=round(height))
        except HyalineError as error:
            raise HyalineError(f"{frame.where}: {error}") from None

    def pose(self, frame: Fields) -> np.ndarray:
        """world_from_camera of a frame, in the file's units."""
        matrix = frame.data.get("transform_matrix")  # type: ignore[union-attr]
        try:
            pose = np.array(matrix, np.float64)
            if pose.shape == (3, 4):
                pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
            check_camera(Camera(world_from_camera=pose, fov_x=1.0, width=1, height=1))
        except (TypeError, ValueError, HyalineError) as error:
            raise HyalineError(f"{frame.where}.transform_matrix: {error}") from None
        return pose

    def find(self, frame: Fields, key: str) -> Path:
        """The file that a frame names, with or without its ending."""
        where = f"{frame.where}.{key}"
        name = frame.text(key).removeprefix("./")
        for ending in ENDINGS:
            path = find_file(self.root, name + ending, where=where)
            if path.is_file():
                return path
        raise HyalineError(f"{where}: names {shown(name)}, which is not in {self.root}; download the whole scene")


def refuse_other_lens(lens: Lens, first: Lens, *, where: str) -> None:
    """Refuses a lens that is not the first one's."""
    middle = (first.size.width / 2, first.size.height / 2)
    apart = np.abs(np.subtract(lens.center or middle, first.center or middle)).max()
    is_shifted = apart > TOLERANCE * first.size.width
    if lens.size != first.size or abs(lens.fov_x / first.fov_x - 1) > TOLERANCE or is_shifted:
        raise HyalineError(
            f"{where}: its lens sees {math.degrees(lens.fov_x):.4g} degrees in {lens.size} pixels, that of the first "
            f"picture {math.degrees(first.fov_x):.4g} in {first.size} pixels; expected one lens for all, with one "
            "principal point"
        )


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture by its header."""
    try:
        with open_regular(path) as file, Image.open(file, formats=["PNG", "JPEG", "WEBP"]) as picture:
            return picture.size
    except HyalineError:
        raise
    except Exception as error:
        raise HyalineError(f"{path}: not a picture that can be read ({type(error).__name__})") from error
