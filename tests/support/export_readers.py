"""Readers of exported datasets, each written from its format's own documentation and sharing nothing with the writers.

A reader gives, by the name of each picture, where its file is and a function that takes world points (n, 3) to pixels
(n, 2), column and row, in which (0.5, 0.5) is the centre of the upper left pixel.
"""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReadView:
    """A picture as a reader finds it."""

    file: Path
    project: Callable[[np.ndarray], np.ndarray]
    frame: dict = dataclasses.field(default_factory=dict)


def read_picture(file: Path) -> np.ndarray:
    with Image.open(file) as picture:
        return np.asarray(picture)


def read_nerfstudio(root: Path) -> tuple[dict[str, ReadView], dict[str, list[str]]]:
    """transforms.json of nerfstudio-data: frames sorted by file, splits by lists of files."""
    meta = json.loads((root / "transforms.json").read_text())
    assert meta["camera_model"] == "PINHOLE"
    views = {}
    for frame in sorted(meta["frames"], key=lambda frame: frame["file_path"]):
        views[Path(frame["file_path"]).stem] = ReadView(
            file=root / frame["file_path"], project=_opengl(frame["transform_matrix"], meta), frame=frame
        )
    splits = {name: [Path(file).stem for file in meta[f"{name}_filenames"]] for name in ("train", "val", "test")}
    return views, splits


def _opengl(matrix: list, meta: dict) -> Callable[[np.ndarray], np.ndarray]:
    camera_from_world = np.linalg.inv(np.array(matrix))

    def project(points: np.ndarray) -> np.ndarray:
        x, y, z = (points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]).T
        return np.stack([meta["cx"] + meta["fl_x"] * x / -z, meta["cy"] - meta["fl_y"] * y / -z], axis=-1)

    return project


def read_blender(root: Path, split: str) -> dict[str, ReadView]:
    """transforms_SPLIT.json as Gaussian splatting reads it: `.png` added, axes turned, pixels from normalised ones."""
    meta = json.loads((root / f"transforms_{split}.json").read_text())
    views = {}
    for frame in meta["frames"]:
        file = root / (frame["file_path"] + ".png")
        height, width = read_picture(file).shape[:2]
        c2w = np.array(frame["transform_matrix"])
        c2w[:3, 1:3] *= -1
        w2c = np.linalg.inv(c2w)
        fov_x = meta["camera_angle_x"]
        fov_y = 2 * math.atan(height / (2 * (width / (2 * math.tan(fov_x / 2)))))

        def project(
            points: np.ndarray, w2c: np.ndarray = w2c, size: tuple = (width, height), fov: tuple = (fov_x, fov_y)
        ) -> np.ndarray:
            x, y, z = (points @ w2c[:3, :3].T + w2c[:3, 3]).T
            ndc = np.stack([x / z / math.tan(fov[0] / 2), y / z / math.tan(fov[1] / 2)], axis=-1)
            return ((ndc + 1) * size - 1) * 0.5 + 0.5  # Its pixel 0 has its centre at 0.

        views[file.stem] = ReadView(file=file, project=project, frame=frame)
    return views


def read_colmap_text(root: Path) -> tuple[dict[str, ReadView], np.ndarray]:
    """sparse/0/*.txt: views, and rows of points (position and colour); neither has tracks."""
    model = root / "sparse" / "0"
    (camera,) = [line.split() for line in _lines(model / "cameras.txt")]
    assert camera[:2] == ["1", "PINHOLE"]
    lens = [float(value) for value in camera[4:]]
    # Empty lines count: a picture without points has one.
    lines = [line for line in (model / "images.txt").read_text().splitlines() if not line.startswith("#")]
    views = {}
    for head, points in zip(lines[::2], lines[1::2], strict=True):
        _, *pose, camera_id, name = head.split()
        assert camera_id == "1"
        views[Path(name).stem] = ReadView(file=root / "images" / name, project=_colmap(list(map(float, pose)), lens))
        assert not points
    return views, np.array([line.split()[1:7] for line in _lines(model / "points3D.txt")], float)


def _lines(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if line and not line.startswith("#")]


def _colmap(pose: list[float], lens: list[float]) -> Callable[[np.ndarray], np.ndarray]:
    """World to camera by a quaternion (w, x, y, z) and a translation; x right, y down, z ahead."""
    w, x, y, z = pose[:4]
    rotation = np.array(
        [
            [1 - 2 * y * y - 2 * z * z, 2 * x * y - 2 * w * z, 2 * x * z + 2 * w * y],
            [2 * x * y + 2 * w * z, 1 - 2 * x * x - 2 * z * z, 2 * y * z - 2 * w * x],
            [2 * x * z - 2 * w * y, 2 * y * z + 2 * w * x, 1 - 2 * x * x - 2 * y * y],
        ]
    )
    fx, fy, cx, cy = lens

    def project(points: np.ndarray) -> np.ndarray:
        px, py, pz = (points @ rotation.T + np.array(pose[4:])).T
        return np.stack([fx * px / pz + cx, fy * py / pz + cy], axis=-1)

    return project


def read_ply_points(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, normals and colours, as trimesh reads them."""
    rows = trimesh.load(path, file_type="ply").metadata["_ply_raw"]["vertex"]["data"]  # pyright: ignore
    columns = (("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue"))
    return tuple(np.stack([rows[name].ravel() for name in group], axis=-1) for group in columns)  # type: ignore[return-value]
