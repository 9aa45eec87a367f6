"""Transforms files: cameras as NeRF tools write and read them, in a dataset, beside a scene, or of anybody's.

    {"camera_angle_x": 0.69, "fl_x": 44.4, "fl_y": 44.4, "cx": 16, "cy": 16, "w": 32, "h": 32,
     "frames": [{"file_path": "images/train/0000", "transform_matrix": [[...], ...]}, ...]}

The convention of `transform_matrix` is that of `cameras.py`. Other programs leave out keys, and write keys of the lens
in a frame, too, where they hold for this frame alone.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from datagen.data.cameras import TOLERANCE, Cameras, Lens, check_lens, check_pose
from datagen.data.config import ANGLE_SPLITS, MAX_VIEWS, Split
from datagen.data.paths import view_name
from datagen.disk.errors import HyalineError, shown
from datagen.disk.records import MAX_JSON_BYTES, Json, dump_json, parse_json
from datagen.disk.storage import read_regular

TRANSFORMS_FILES: dict[Split, str] = {
    "train": "transforms_train.json",
    "interpolating": "transforms_test.json",
    "extrapolating": "transforms_extrapolating.json",
    **{split: f"transforms_{split}.json" for split in ANGLE_SPLITS},
}
CONVENTION = "transform_matrix is world_from_camera, OpenGL: +x right, +y up, looks along -z; world +z up; m"

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
LENS_KEYS = ("camera_model", "is_fisheye", "camera_angle_x", "fl_x", "fl_y", "cx", "cy", "w", "h", *DISTORTION)
PINHOLES = ("PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Camera models, as COLMAP and NeRF tools name them, of pinholes with or without distortion."""


# Writing


def lens_keys(lens: Lens) -> dict[str, Json]:
    """The lens that all views share: angle in radians, focal lengths and principal point in pixels."""
    column, row = lens.principal_point
    return {
        "camera_angle_x": lens.fov_x,
        "fl_x": lens.focal,
        "fl_y": lens.focal,
        "cx": column,
        "cy": row,
        "w": lens.width,
        "h": lens.height,
    }


def transforms_bytes(cameras: Cameras, split: Split) -> bytes:
    """The file of a split's cameras."""
    bounds: dict[str, Json] = {"near": cameras.near, "far": cameras.far}
    return dump_json(
        {
            "convention": CONVENTION,
            **lens_keys(cameras),
            **{key: value for key, value in bounds.items() if value is not None},
            "frames": [
                {"file_path": f"images/{split}/{view_name(view)}", "transform_matrix": matrix.tolist()}
                for view, matrix in enumerate(cameras.world_from_camera)
            ],
        }
    )


# Reading


@dataclass(frozen=True, kw_only=True)
class Frame:
    """What a file says of one picture."""

    data: Mapping[str, Json]
    where: str

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def text(self, key: str) -> str:
        """A name; empty where there is none."""
        value = self.data.get(key, "")
        if not isinstance(value, str):
            raise HyalineError(f"{self.where}.{key}: is {shown(value)}; expected a string")
        return value

    def file(self, key: str) -> str:
        """A file's path from the folder; empty where there is none."""
        return relative_name(self.text(key))


def relative_name(name: str) -> str:
    """The path that a file names, also as Windows writes it."""
    return name.replace("\\", "/").removeprefix("./")


class Transforms:
    """A transforms file, parsed; lens and pose of a frame are checked when they are asked for."""

    def __init__(self, data: bytes, *, where: str, least: int = 1, most: int = MAX_VIEWS) -> None:
        self.content = parse_json(data, where=where)
        self.where = where
        frames = self.content.get("frames", [])
        if not isinstance(frames, list) or not least <= len(frames) <= most:
            count = len(frames) if isinstance(frames, list) else "no list of"
            raise HyalineError(f"{where}: has {count} frames; expected {least} to {most:,}")
        self.frames = [self._frame(frame, index) for index, frame in enumerate(frames)]

    def _frame(self, frame: Json, index: int) -> Frame:
        where = f"{self.where}: frames[{index}]"
        if not isinstance(frame, dict):
            raise HyalineError(f"{where}: is {shown(frame)}; expected an object")
        return Frame(data=frame, where=where)

    def other_model(self, frame: Frame) -> str:
        """The camera model of a frame that is not a pinhole, such as a fisheye or a panorama; empty for a pinhole."""
        both = {**self.content, **frame.data}
        name = str(both.get("camera_model") or "")
        if name and name.upper() not in PINHOLES:
            return shown(name)
        return "is_fisheye" if both.get("is_fisheye") is True else ""  # As instant-ngp marks it.

    def pose(self, frame: Frame) -> np.ndarray:
        """world_from_camera of a frame, in the file's units."""
        try:
            pose = np.array(frame.data.get("transform_matrix"), np.float64)
            if pose.shape == (3, 4):
                pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
            check_pose(pose)
        except (TypeError, ValueError, HyalineError) as error:
            raise HyalineError(f"{frame.where}.transform_matrix: {error}") from None
        return pose

    def lens(self, frame: Frame | None = None, *, size: tuple[int, int] | None = None) -> Lens:
        """The lens of a frame, or that of all frames.

        Args:
            size: of the picture, for a file that does not say it; by default the lens is of a picture of one pixel,
                which fits any shape.
        """
        frame = frame or Frame(data={}, where=self.where)
        number = partial(self.number, frame=frame)
        bent = [key for key in DISTORTION if abs(number(key, 0.0)) > 1e-9]
        other = self.other_model(frame)
        focal = number("fl_x", 0.0)
        if bent or other:
            what = f"camera is not a pinhole camera ({other})" if other else f"lens is distorted ({', '.join(bent)})"
            raise HyalineError(
                f"{frame.where}: its {what}; expected straight lines, undistort the pictures first (`colmap "
                "image_undistorter`)"
            )
        if focal > 0 and abs(number("fl_y", focal) / focal - 1) > TOLERANCE:
            raise HyalineError(
                f"{frame.where}: has focal lengths {focal:g} and {number('fl_y', focal):g}; expected square pixels, of "
                "equal ones"
            )
        width, height = number("w", 2 * number("cx", 0.0)), number("h", 0.0)
        has_size = all(key in frame or key in self.content for key in ("w", "h"))
        # Where both are given, the angle is exact, and the focal length may be rounded.
        angle = number("camera_angle_x", 0.0)
        if not has_size and size is not None:
            # In the file's pixels, by what it says; a principal point is within an eighth of the middle.
            by_center = 2 * number("cx", 0.0) / size[0]
            told = number("w", 0.0) / size[0] or number("h", 0.0) / size[1]
            scale = told or (by_center if abs(by_center - 1) > 0.25 else 1.0) or 1.0
            width, height = scale * size[0], scale * size[1]
            focal = focal if told or not angle else 0.0
        by_focal = 2 * math.atan(0.5 * width / focal) if focal > 0 and width > 0 else angle
        angle = angle if abs(angle - by_focal) < 1e-9 else by_focal
        if not 0 < angle < math.pi:
            raise HyalineError(
                f"{frame.where}: has no lens; expected camera_angle_x in radians, or fl_x and w in pixels"
            )
        if not has_size and size is None:
            return Lens(fov_x=angle, width=1, height=1)
        center = number("cx", width / 2), number("cy", height / 2)
        is_central = center == (width / 2, height / 2)
        lens = Lens(fov_x=angle, width=round(width), height=round(height), center=None if is_central else center)
        try:
            check_lens(lens)
        except HyalineError as error:
            raise HyalineError(f"{frame.where}: {error}") from None
        return lens

    def shared_lens(self, size: tuple[int, int] | None = None) -> Lens:
        """The lens of all frames; an error where one has another."""
        found = self.lens(self.frames[0], size=size)
        for frame in self.frames[1:]:
            if any(key in frame for key in LENS_KEYS):
                refuse_other_lens(self.lens(frame, size=size), found, where=frame.where)
        return found

    def number(self, key: str, default: float = 0.0, *, frame: Frame | None = None) -> float:
        """What a frame says, or else what the file says of all frames."""
        where, value = self.where, self.content.get(key, default)
        if frame is not None and key in frame:
            where, value = frame.where, frame.data[key]
        if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
            raise HyalineError(f"{where}.{key}: is {shown(value)}; expected a number")
        return float(value)


def read_transforms(path: Path, *, most: int = MAX_VIEWS) -> Transforms:
    """A transforms file, parsed."""
    return Transforms(read_regular(path, at_most=MAX_JSON_BYTES), where=str(path), most=most)


def refuse_other_lens(lens: Lens, first: Lens, *, where: str) -> None:
    """Raises a HyalineError that names both lenses unless they are alike."""
    if not lens.is_like(first):
        raise HyalineError(
            f"{where}: its lens sees {math.degrees(lens.fov_x):.4g} degrees in {lens.width} x {lens.height} pixels, "
            f"that of the first picture {math.degrees(first.fov_x):.4g} in {first.width} x {first.height}; expected "
            "one lens for all, with one principal point"
        )


def parse_transforms(data: bytes, *, where: str) -> Cameras:
    """The cameras in a file of one lens, such as `transforms_bytes` writes."""
    file = Transforms(data, where=where, least=0)
    poses = [file.pose(frame) for frame in file.frames]
    lens = file.shared_lens() if file.frames else file.lens()
    near, far = (file.number(key) if key in file.content else None for key in ("near", "far"))
    return dataclasses.replace(lens.cameras(np.array(poses, np.float64).reshape(-1, 4, 4)), near=near, far=far)
