"""Cameras of a foreign scene: those of COLMAP or of a transforms file beside the model, and their splits.

Source: COLMAP's documentation of its output format, and the list of its camera models.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datagen.data.config import MAX_VIEWS
from datagen.disk.errors import HyalineError
from datagen.disk.names import find_file
from datagen.disk.records import shown
from datagen.scene.camera_list import DEFAULT_FOV_DEG, CameraList, Intrinsics, matrix_rows
from datagen.scene.importers.foreign import ForeignCamera, read_foreign
from datagen.scene.importers.remarks import Remarks
from datagen.scene.importers.transforms import DISTORTED, NOT_SQUARE, TOLERANCE, TransformsFile

NAMES = ("transforms.json", "transforms_train.json")


def read_camera_file(given: Path, remarks: Remarks) -> tuple[ForeignCamera, ...]:
    """The cameras in a folder or a file, in the axes and units of the model that they belong to."""
    if given.is_dir() and has_colmap(given):
        return read_colmap(given, remarks)
    if given.is_dir():
        found = next((given / name for name in NAMES if (given / name).is_file()), None)
        if found is None:
            raise HyalineError(
                f"{given}: holds no cameras; expected {' or '.join(NAMES)}, or cameras.bin and images.bin of COLMAP"
            )
        given = found
    if given.suffix.lower() != ".json" or not given.is_file():
        raise HyalineError(
            f"--cameras {given}: is not a file; expected around, file, a transforms.json, or a folder of COLMAP's"
        )
    file = TransformsFile(given.parent, given.name)
    cameras = []
    for frame in file.frames:
        angle, lens, left_out = file.angle(frame)
        for line in left_out:
            remarks.approximate("cameras", line)
        cameras.append(ForeignCamera(world_from_camera=file.pose(frame), fov_deg=math.degrees(angle), intrinsics=lens))
    return tuple(cameras)


def listed_cameras(
    cameras: Sequence[ForeignCamera], linear: Float[np.ndarray, "3 3"], offset: Float[np.ndarray, "3"], remarks: Remarks
) -> CameraList:
    """Cameras of a file in our world: the outermost for extrapolation, every eighth other one for interpolation.

    Of fewer than three, each split has all.
    """
    if not cameras:
        raise HyalineError("--cameras file: the file brings no cameras; leave it out")
    fov_deg, intrinsics = cameras[0].fov_deg, cameras[0].intrinsics
    if any(abs(camera.fov_deg - fov_deg) > 1e-3 or camera.intrinsics != intrinsics for camera in cameras):
        remarks.approximate(
            "cameras", f"have several lenses; all of them get the first one's, which sees {fov_deg:.3g} degrees"
        )
    if intrinsics is not None:
        fov_deg = DEFAULT_FOV_DEG
    rotation = linear / abs(np.linalg.det(linear)) ** (1 / 3)
    matrices = []
    for camera in cameras:
        matrix = np.eye(4)
        matrix[:3, :3] = rotation @ camera.world_from_camera[:3, :3]
        matrix[:3, 3] = linear @ camera.world_from_camera[:3, 3] + offset
        matrices.append(matrix)
    listed = [matrix_rows(matrix) for matrix in matrices]
    if len(listed) < 3:
        return CameraList(
            train=tuple(listed),
            interpolating=tuple(listed),
            extrapolating=tuple(listed),
            fov_deg=fov_deg,
            intrinsics=intrinsics,
        )
    places = np.array([matrix[:3, 3] for matrix in matrices])
    outermost = int(np.linalg.norm(places - places.mean(axis=0), axis=-1).argmax())
    others = [rows for index, rows in enumerate(listed) if index != outermost]
    return CameraList(
        train=tuple(rows for index, rows in enumerate(others) if index % 8),
        interpolating=tuple(others[::8]),
        extrapolating=(listed[outermost],),
        fov_deg=fov_deg,
        intrinsics=intrinsics,
    )


# COLMAP


@dataclass(frozen=True, kw_only=True)
class _Model:
    """A camera model: its name, and how many numbers it has; the focal lengths come first, then the middle."""

    name: str
    numbers: int
    focals: int = 1


MODELS = {
    0: _Model(name="SIMPLE_PINHOLE", numbers=3),
    1: _Model(name="PINHOLE", numbers=4, focals=2),
    2: _Model(name="SIMPLE_RADIAL", numbers=4),
    3: _Model(name="RADIAL", numbers=5),
    4: _Model(name="OPENCV", numbers=8, focals=2),
    6: _Model(name="FULL_OPENCV", numbers=12, focals=2),
}
"""By COLMAP's number. The others are of lenses that see wider than a plane shows."""
IMAGE, POINT = struct.Struct("<I7dI"), 24
CAMERA = struct.Struct("<IiQQ")
FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0")
"""Where reconstructions lie in the folders of a capture."""


@dataclass(frozen=True, kw_only=True)
class _Lens:
    width: int
    height: int
    model: _Model
    values: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class _Image:
    name: str
    camera: int
    pose: tuple[float, ...]
    """Quaternion (w, x, y, z) and translation: from the world to the camera, which looks along +z, +y down."""


def has_colmap(root: Path) -> bool:
    """True where a folder holds a reconstruction."""
    return _place(root) is not None


def read_colmap(root: Path, remarks: Remarks) -> tuple[ForeignCamera, ...]:
    """The cameras of a folder, in the order of their pictures' names."""
    found = _place(root)
    assert found is not None, "called only if has_colmap is true"
    folder, ending = found
    paths = [find_file(folder, f"{name}.{ending}", where=str(folder)) for name in ("cameras", "images")]
    lenses, images = (_read_binary if ending == "bin" else _read_text)(*paths)
    if not 1 <= len(images) <= MAX_VIEWS:
        raise HyalineError(f"{paths[1]}: has {len(images):,} images; expected 1 to {MAX_VIEWS:,}")
    cameras = []
    for image in sorted(images, key=lambda image: image.name):
        where = f"{paths[1]}: {shown(image.name)}"
        if image.camera not in lenses:
            raise HyalineError(f"{where}: was taken by camera {image.camera}; expected one that {paths[0].name} has")
        lens = _intrinsics(lenses[image.camera], remarks, where=where)
        pose = _world_from_camera(image, where=where)
        cameras.append(ForeignCamera(world_from_camera=pose, fov_deg=math.degrees(lens.fov_x), intrinsics=lens))
    return tuple(cameras)


def _place(root: Path) -> tuple[Path, str] | None:
    """The folder of a reconstruction, and the ending of its files."""
    for folder in FOLDERS:
        for ending in ("bin", "txt"):
            if all((root / folder / f"{name}.{ending}").is_file() for name in ("cameras", "images")):
                return root / folder, ending
    return None


def _intrinsics(lens: _Lens, remarks: Remarks, *, where: str) -> Intrinsics:
    numbers = lens.values
    column, row = numbers[lens.model.focals : lens.model.focals + 2]
    if not (numbers[0] > 0 and lens.width > 0 and lens.height > 0 and np.isfinite(numbers).all()):
        raise HyalineError(
            f"{where}: has a focal length of {numbers[0]:g} in pictures {lens.width} pixels wide; expected more than 0"
        )
    if any(abs(value) > 1e-9 for value in numbers[lens.model.focals + 2 :]):
        remarks.approximate("cameras", DISTORTED)
    if abs(numbers[lens.model.focals - 1] / numbers[0] - 1) > TOLERANCE:
        remarks.approximate("cameras", NOT_SQUARE)
    focal = numbers[0]
    try:
        return Intrinsics(fl_x=focal, fl_y=focal, cx=column, cy=row, w=lens.width, h=lens.height)
    except HyalineError as error:
        raise HyalineError(f"{where}: {error}") from None


def _world_from_camera(image: _Image, *, where: str) -> np.ndarray:
    quaternion, place = np.array(image.pose[:4]), np.array(image.pose[4:])
    length = float(np.linalg.norm(quaternion))
    if not (0.5 < length < 2 and np.abs(place).max() < 1e12):
        raise HyalineError(f"{where}: has a rotation of length {length:g}; expected a quaternion of length 1")
    w, x, y, z = quaternion / length
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    # COLMAP's cameras look along +z with +y down; OpenGL's look along -z with +y up.
    matrix[:3, :3] = rotation.T * [1, -1, -1]
    matrix[:3, 3] = -rotation.T @ place
    return matrix


# Binary


def _read_binary(cameras: Path, images: Path) -> tuple[dict[int, _Lens], list[_Image]]:
    try:
        return _binary_lenses(cameras), _binary_images(images)
    except (struct.error, ValueError) as error:
        raise HyalineError(
            f"{cameras.parent}: its cameras or images are cut off ({error}); export them again"
        ) from None


def _binary_lenses(path: Path) -> dict[int, _Lens]:
    data = read_foreign(path)
    lenses, at = {}, 8
    for _ in range(_count(data, path)):
        camera, number, width, height = CAMERA.unpack_from(data, at)
        model = _model(MODELS.get(number), number, where=str(path))
        values = struct.unpack_from(f"<{model.numbers}d", data, at + CAMERA.size)
        lenses[camera] = _Lens(width=width, height=height, model=model, values=values)
        at += CAMERA.size + 8 * model.numbers
    return lenses


def _binary_images(path: Path) -> list[_Image]:
    data = read_foreign(path)
    images, at = [], 8
    for _ in range(_count(data, path)):
        _, *pose, camera = IMAGE.unpack_from(data, at)
        end = data.index(b"\0", at + IMAGE.size)
        name = data[at + IMAGE.size : end].decode(errors="replace")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + POINT * points
        if at > len(data):
            raise ValueError(f"{points:,} points of {shown(name)}")
        images.append(_Image(name=name, camera=camera, pose=tuple(pose)))
    return images


def _count(data: bytes, path: Path) -> int:
    (count,) = struct.unpack_from("<Q", data)
    if count > MAX_VIEWS:
        raise HyalineError(f"{path}: has {count:,} entries; expected at most {MAX_VIEWS:,}")
    return count


# Text


def _read_text(cameras: Path, images: Path) -> tuple[dict[int, _Lens], list[_Image]]:
    by_name = {model.name: model for model in MODELS.values()}
    lenses: dict[int, _Lens] = {}
    listed: list[_Image] = []
    where = str(cameras)
    try:
        for words in _lines(cameras):
            if words:
                model = _model(by_name.get(words[1]), words[1], where=where)
                values = tuple(map(float, words[4:]))
                if len(values) != model.numbers:
                    raise ValueError(f"{len(values)} numbers of a {model.name}")
                lens = _Lens(width=int(words[2]), height=int(words[3]), model=model, values=values)
                lenses[int(words[0])] = lens
        where = str(images)
        # Each image is two lines, the second of which lists its points, and may be empty.
        for words in _lines(images)[::2]:
            if words:
                pose = tuple(map(float, words[1:8]))
                listed.append(_Image(name=" ".join(words[9:]), camera=int(words[8]), pose=pose))
    except (ValueError, IndexError) as error:
        raise HyalineError(f"{where}: has a line that cannot be read ({error}); export it again") from None
    return lenses, listed


def _lines(path: Path) -> list[list[str]]:
    """The words of each line but comments, empty lines included."""
    text = read_foreign(path).decode(errors="replace")
    return [line.split() for line in text.splitlines() if not line.startswith("#")]


def _model(model: _Model | None, given: object, *, where: str) -> _Model:
    if model is None:
        known = ", ".join(model.name for model in MODELS.values())
        raise HyalineError(
            f"{where}: has a camera of model {shown(str(given))}; expected one of {known}; undistort the pictures "
            "first (`colmap image_undistorter`)"
        )
    return model
