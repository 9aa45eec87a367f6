"""Camera paths for films: a turn around a scene, or a curve through its test views."""

import math

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Cameras, look_at
from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.scene.description import CameraList, CameraRig
from datagen.scene.folder import listed_cameras, open_scene

NAMES = ("orbit", "spline")
MAX_FRAMES = 10_000
FULL_TURN_DEG = 359.0
"""Degrees of a circle; a rig whose cameras cover this much leaves room for a whole orbit."""


def make_path(dataset: Dataset, path: str, frames: int, *, width: int | None, height: int | None) -> Cameras:
    """The cameras of a film.

    Args:
        path: `orbit` turns around the scene at its cameras' middle elevation, or swings to and fro where walls leave
            less than a circle; `spline` runs through the interpolating test views. A spline has the dataset's lens,
            principal point included; an orbit has its target in the middle of the pictures.
        frames: how many cameras; those of an orbit repeat without a jump.
        width: of the pictures, in pixels; the dataset's unless given. The lens's horizontal angle stays.
        height: of the pictures, in pixels; the width's share of the dataset's aspect unless given.
    """
    if not 2 <= frames <= MAX_FRAMES:
        raise HyalineError(f"--frames: is {frames}; expected 2 to {MAX_FRAMES:,}")
    if path not in NAMES:
        raise HyalineError(f"--path: is {path!r}; expected {' or '.join(NAMES)}")
    views = lens = dataset.cameras("interpolating")
    wide = lens.width if width is None else width
    high = round(wide * lens.height / lens.width) if height is None else height
    for name, value in (("--width", wide), ("--height", high)):
        if not 1 <= value <= 8192:
            raise HyalineError(f"{name}: is {value}; expected 1 to 8192 pixels")
    center = lens.center
    if path == "orbit":
        rig = open_scene(dataset).cameras if dataset.objects else listed_cameras(dataset)  # Without meshes, no scene.
        poses, center = _orbit(rig, frames), None
    else:
        poses = _curve(views.world_from_camera, frames)
    if center is not None:
        center = (center[0] / lens.width * wide, center[1] / lens.height * high)
    return Cameras(world_from_camera=poses, fov_x=lens.fov_x, width=wide, height=high, center=center)


def _orbit(rig: CameraRig | CameraList, frames: int) -> Float[np.ndarray, "view 4 4"]:
    first, last = rig.azimuth_deg
    turn = np.arange(frames) / frames
    if last - first >= FULL_TURN_DEG:
        azimuth = np.radians(first + 360 * turn)
    else:
        azimuth = np.radians((first + last) / 2 + 0.45 * (last - first) * np.sin(2 * np.pi * turn))
    elevation = math.radians(sum(rig.elevation_deg) / 2)
    across = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1) * math.cos(elevation)
    places = np.array(rig.target) + rig.radius * np.pad(across, ((0, 0), (0, 1)), constant_values=math.sin(elevation))
    return np.stack([look_at(place, rig.target) for place in places])


def _curve(keys: Float[np.ndarray, "key 4 4"], frames: int) -> Float[np.ndarray, "view 4 4"]:
    """A curve through key cameras, evenly timed between them: places by cubic splines, turns by rotation splines."""
    from scipy.interpolate import PchipInterpolator
    from scipy.spatial.transform import Rotation, RotationSpline

    if len(keys) < 2:
        return np.repeat(keys, frames, axis=0)
    # Monotone between key frames, so that the camera never swings through a wall that they avoid.
    times, at = np.arange(len(keys)), np.linspace(0, len(keys) - 1, frames)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, 3] = PchipInterpolator(times, keys[:, :3, 3])(at)
    poses[:, :3, :3] = RotationSpline(times, Rotation.from_matrix(keys[:, :3, :3]))(at).as_matrix()
    return poses
