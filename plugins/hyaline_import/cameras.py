"""Cameras that COLMAP has found.

Source: COLMAP's documentation of its output format, and the list of its camera models.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.data.config import MAX_VIEWS
from datagen.disk.errors import HyalineError, shown
from datagen.disk.storage import find_file
from hyaline_import.foreign import read_foreign

MODELS = {
    "SIMPLE_PINHOLE": (0, 1, 3),
    "PINHOLE": (1, 2, 4),
    "SIMPLE_RADIAL": (2, 1, 4),
    "RADIAL": (3, 1, 5),
    "OPENCV": (4, 2, 8),
    "FULL_OPENCV": (6, 2, 12),
}
"""COLMAP's number of a camera model, its focal lengths, and all its numbers: then come the middle, and distortion. The
others are of lenses that see wider than a plane shows."""
CAMERA, IMAGE, POINT = struct.Struct("<IiQQ"), struct.Struct("<I7dI"), 24
TRACED = struct.Struct("<Q3d3BdQ")
"""A point: number, place, colour, error, and how many images show it."""
FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0")
"""Where reconstructions lie in the folders of a capture."""


@dataclass(frozen=True, kw_only=True)
class ColmapCamera:
    """A camera as COLMAP lists it: focal lengths, principal point, distortion."""

    width: int
    height: int
    model: str
    values: tuple[float, ...]

    @property
    def focals(self) -> int:
        """How many of the values are focal lengths."""
        return MODELS[self.model][1]


Image = tuple[str, int, tuple[float, ...]]
"""Name, camera, and pose: a quaternion (w, x, y, z) and a translation, from the world to the camera."""


def has_colmap(root: Path) -> bool:
    """True where a folder holds a reconstruction."""
    return _place(root) is not None


def colmap_images(root: Path) -> dict[str, tuple[ColmapCamera, Float[np.ndarray, "4 4"], str]]:
    """By the names of the pictures, in order: camera, world_from_camera, and where it is read from."""
    found = _place(root)
    assert found is not None, "called only if has_colmap is true"
    folder, ending = found
    paths = [find_file(folder, f"{name}.{ending}", where=str(folder)) for name in ("cameras", "images")]
    try:
        lenses, images = (_read_binary if ending == "bin" else _read_text)(*paths)
    except (struct.error, ValueError, IndexError) as error:
        raise HyalineError(f"{folder}: its cameras or images are damaged ({error}); export them again") from None
    if not 1 <= len(images) <= MAX_VIEWS:
        raise HyalineError(f"{paths[1]}: has {len(images):,} images; expected 1 to {MAX_VIEWS:,}")
    read = {}
    for name, camera, pose in sorted(images):
        where = f"{paths[1]}: {shown(name)}"
        if camera not in lenses:
            raise HyalineError(f"{where}: was taken by camera {camera}; expected one that {paths[0].name} has")
        row = lenses[camera]
        if not (row.values[0] > 0 and row.width > 0 and row.height > 0 and np.isfinite(row.values).all()):
            raise HyalineError(
                f"{where}: has a focal length of {row.values[0]:g} in pictures {row.width} pixels wide; expected more "
                "than 0"
            )
        read[name] = row, _world_from_camera(np.array(pose), where=where), where
    return read


def colmap_points(root: Path) -> Float[np.ndarray, "point 3"]:
    """The points of a reconstruction; none without its file."""
    found = _place(root)
    assert found is not None, "called only if has_colmap is true"
    path = found[0] / f"points3D.{found[1]}"
    if not path.is_file():
        return np.zeros((0, 3))
    try:
        if found[1] == "txt":
            points = [[float(word) for word in words[1:4]] for words in map(str.split, _lines(path)) if words]
        else:
            points, data, at = [], read_foreign(path), 8
            for _ in range(struct.unpack_from("<Q", data)[0]):
                _, *place, _, _, _, _, seen = TRACED.unpack_from(data, at)
                points.append(place)
                at += TRACED.size + 8 * seen
        return np.array(points, np.float64).reshape(-1, 3)
    except (struct.error, ValueError) as error:
        raise HyalineError(f"{path}: is cut off or damaged ({error}); export it again") from None


def _place(root: Path) -> tuple[Path, str] | None:
    """The folder of a reconstruction, and the ending of its files."""
    for folder in FOLDERS:
        for ending in ("bin", "txt"):
            if all((root / folder / f"{name}.{ending}").is_file() for name in ("cameras", "images")):
                return root / folder, ending
    return None


def _world_from_camera(pose: Float[np.ndarray, "7"], *, where: str) -> Float[np.ndarray, "4 4"]:
    length = float(np.linalg.norm(pose[:4]))
    if not (0.5 < length < 2 and np.abs(pose[4:]).max() < 1e12):
        raise HyalineError(f"{where}: has a rotation of length {length:g}; expected a quaternion of length 1")
    rotation = Rotation.from_quat(np.roll(pose[:4], -1)).as_matrix()
    matrix = np.eye(4)
    # COLMAP's cameras look along +z with +y down; OpenGL's look along -z with +y up.
    matrix[:3, :3] = rotation.T * [1, -1, -1]
    matrix[:3, 3] = -rotation.T @ pose[4:]
    return matrix


def _read_binary(cameras: Path, images: Path) -> tuple[dict[int, ColmapCamera], list[Image]]:
    lenses, listed = {}, []
    data, at = read_foreign(cameras), 8
    names = {number: name for name, (number, _, _) in MODELS.items()}
    for _ in range(_count(data)):
        camera, number, width, height = CAMERA.unpack_from(data, at)
        model = _known(names.get(number, str(number)), where=str(cameras))
        values = struct.unpack_from(f"<{MODELS[model][2]}d", data, at + CAMERA.size)
        lenses[camera] = ColmapCamera(width=width, height=height, model=model, values=values)
        at += CAMERA.size + 8 * len(values)
    data, at = read_foreign(images), 8
    for _ in range(_count(data)):
        _, *pose, camera = IMAGE.unpack_from(data, at)
        end = data.index(b"\0", at + IMAGE.size)
        listed.append((data[at + IMAGE.size : end].decode(errors="replace"), camera, tuple(pose)))
        at = end + 9 + POINT * struct.unpack_from("<Q", data, end + 1)[0]
        if at > len(data):
            raise ValueError("its points are cut off")
    return lenses, listed


def _count(data: bytes) -> int:
    (count,) = struct.unpack_from("<Q", data)
    if count > MAX_VIEWS:
        raise ValueError(f"{count:,} entries; expected at most {MAX_VIEWS:,}")
    return count


def _read_text(cameras: Path, images: Path) -> tuple[dict[int, ColmapCamera], list[Image]]:
    lenses, listed = {}, []
    for camera, model, width, height, *words in filter(None, map(str.split, _lines(cameras))):
        values = tuple(map(float, words))
        if len(values) != MODELS[_known(model, where=str(cameras))][2]:
            raise ValueError(f"{len(values)} numbers of a {model}")
        lenses[int(camera)] = ColmapCamera(width=int(width), height=int(height), model=model, values=values)
    lines = _lines(images)
    if any(len(points.split()) % 3 for points in lines[1::2]):
        raise ValueError("an image is not followed by a line of its points")
    for line in filter(str.strip, lines[::2]):  # The second line of each image lists its points.
        *numbers, name = line.split(maxsplit=9)  # A name may contain spaces.
        listed.append((name.rstrip(), int(numbers[8]), tuple(map(float, numbers[1:8]))))
    return lenses, listed


def _lines(path: Path) -> list[str]:
    """All lines except comments; empty ones are kept."""
    text = read_foreign(path).decode(errors="replace")
    return [line for line in text.splitlines() if not line.startswith("#")]


def _known(model: str, *, where: str) -> str:
    if model not in MODELS:
        raise HyalineError(
            f"{where}: has a camera of model {shown(model)}; expected one of {', '.join(MODELS)}; undistort the "
            "pictures first (`colmap image_undistorter`)"
        )
    return model
