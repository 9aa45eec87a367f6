"""Camera paths for films: a turn around a scene, a curve through its test views, or another program's key frames."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Camera, Cameras, check_camera, look_at
from datagen.data.config import SPLITS
from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, load_json
from datagen.scene.camera_list import CameraList, list_cameras
from datagen.scene.description import CameraRig
from datagen.scene.folder import load_scene

NAMES = ("orbit", "spline")
MAX_FRAMES = 10_000
FULL_TURN_DEG = 359.0
"""A rig whose cameras stand on so much of the circle, in degrees, has nothing that an orbit could run into."""


def make_path(dataset: Dataset, path: str, frames: int, *, width: int | None, height: int | None) -> Cameras:
    """The cameras of a film.

    Args:
        path: `orbit` turns around the scene at its cameras' middle elevation, or swings to and fro where walls leave
            less than a circle; `spline` runs through the interpolating test views; else a JSON file of key frames
            (`frames`, each with a `transform_matrix`: world_from_camera in the OpenGL convention, as NeRF tools write
            it), through which it runs, too. A spline has the dataset's lens, principal point included, or that which
            the file tells; what an orbit turns around is in the middle of its pictures.
        frames: how many cameras; those of an orbit repeat without a jump.
        width: of the pictures, in pixels; the dataset's unless given. The lens's horizontal angle stays.
        height: of the pictures, in pixels; the width's share of the dataset's aspect unless given.

    Raises:
        HyalineError: an impossible number of frames or pixels, or a file that holds no key frames.
    """
    if not 2 <= frames <= MAX_FRAMES:
        raise HyalineError(f"frames: is {frames}; expected 2 to {MAX_FRAMES}")
    lens = dataset.cameras("interpolating")
    wide = lens.width if width is None else width
    high = round(wide * lens.height / lens.width) if height is None else height
    for name, value in (("width", wide), ("height", high)):
        if not 1 <= value <= 8192:
            raise HyalineError(f"{name}: is {value}; expected 1 to 8192 pixels")
    fov_x, middle = lens.fov_x, _middle_of(lens)
    if path == "orbit":
        poses, middle = _orbit(_rig_of(dataset), frames), None
    elif path == "spline":
        poses = _curve(lens.world_from_camera, frames)
    else:
        keys = _read_keys(Path(path))
        poses = _curve(keys.poses, frames)
        if keys.fov_x is not None:
            fov_x, middle = keys.fov_x, keys.middle
    center = None if middle is None else (middle[0] * wide, middle[1] * high)
    return Cameras(world_from_camera=poses, fov_x=fov_x, width=wide, height=high, center=center)


def _middle_of(lens: Cameras) -> tuple[float, float] | None:
    """The principal point as shares of the picture's width and height; None for its middle."""
    return None if lens.center is None else (lens.center[0] / lens.width, lens.center[1] / lens.height)


def _rig_of(dataset: Dataset) -> CameraRig | CameraList:
    """Where the cameras of a dataset stand; of imported pictures without meshes there is no scene that tells."""
    if dataset.objects:
        return load_scene(dataset.root / "scene", is_sealed=True).cameras
    return list_cameras({split: dataset.cameras(split) for split in SPLITS})


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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Keys:
    """Key cameras, and their lens as far as the file tells it."""

    poses: Float[np.ndarray, "key 4 4"]
    fov_x: float | None
    """Radians."""
    middle: tuple[float, float] | None
    """The principal point as shares of the picture's width and height; None for its middle."""


def _read_keys(file: Path) -> _Keys:
    """The key cameras of a file."""
    if not file.is_file():
        raise HyalineError(f"{file}: no such file; --path takes {', '.join(NAMES)} or a JSON file of key frames")
    data = load_json(file)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames or len(frames) > MAX_FRAMES:
        raise HyalineError(f"{file}: has no frames; expected an object with a list of 1 to {MAX_FRAMES} of them")
    fov_x, middle = _number(data, "camera_angle_x"), _middle_in(data, file)
    keys = []
    for number, frame in enumerate(frames):
        matrix = frame.get("transform_matrix") if isinstance(frame, dict) else None
        try:
            pose = np.array(matrix, np.float64)
            check_camera(Camera(world_from_camera=pose, fov_x=1.0 if fov_x is None else fov_x, width=1, height=1))
        except (TypeError, ValueError, HyalineError) as error:
            raise HyalineError(f"{file}: frames[{number}].transform_matrix: {error}") from None
        keys.append(pose)
    return _Keys(poses=np.stack(keys), fov_x=fov_x, middle=middle)


def _middle_in(data: dict[str, Json], file: Path) -> tuple[float, float] | None:
    """Where a file's principal point is, `cx` and `cy` in pictures of `w` by `h` pixels; None where it says nothing."""
    values = [_number(data, key) for key in ("cx", "cy", "w", "h")]
    if None in values:
        return None
    column, row, width, height = (float(value) for value in values if value is not None)
    if width < 1 or height < 1 or not 0 <= column <= width or not 0 <= row <= height:
        raise HyalineError(
            f"{file}: cx, cy is {column:g}, {row:g} in pictures of {width:g} x {height:g} pixels; expected it inside"
        )
    return column / width, row / height


def _number(data: dict[str, Json], key: str) -> float | None:
    """A value that is a number; None for any other."""
    value = data.get(key)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
