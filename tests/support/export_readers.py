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


def read_bop(scene: Path) -> dict[str, ReadView]:
    """The pictures of a BOP scene, by its specification; `frame` has pose and lens, and of each object gt and info."""
    tables = [json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt", "gt_info")]
    assert tables[0].keys() == tables[1].keys() == tables[2].keys()
    views = {}
    for number, camera in tables[0].items():
        matrix, rotation = np.reshape(camera["cam_K"], (3, 3)), np.reshape(camera["cam_R_w2c"], (3, 3))

        def project(points: np.ndarray, k: np.ndarray = matrix, r: np.ndarray = rotation, t=camera["cam_t_w2c"]):
            x, y, z = k @ (1000 * points @ r.T + t).T
            return np.stack([x / z, y / z], axis=-1) + 0.5  # Its pixel 0 has its centre at 0.

        frame = {"number": int(number), "matrix": matrix, "gt": tables[1][number], "info": tables[2][number]}
        views[camera["view"]] = ReadView(file=scene / f"rgb/{int(number):06d}.png", project=project, frame=frame)
    return views


def bop_visibility(root: Path, scene: Path, frame: dict, index: int) -> tuple[np.ndarray, np.ndarray, dict]:
    """Mask, visible mask and scene_gt_info of an object, as the toolkit's calc_gt_info.py finds them with a renderer.

    On a canvas of three pictures by three, within 15 mm.
    """
    depth = read_picture(scene / f"depth/{frame['number']:06d}.png").astype(float)
    (height, width), gt, k = depth.shape, frame["gt"][index], frame["matrix"]
    rows, columns = np.mgrid[-height : 2 * height, -width : 2 * width]
    rays = np.stack([(columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1], np.ones(rows.shape)], axis=-1)
    mesh = trimesh.load_mesh(root / f"models/obj_{gt['obj_id']:06d}.ply")
    mesh.apply_transform(np.vstack([np.c_[np.reshape(gt["cam_R_m2c"], (3, 3)), gt["cam_t_m2c"]], [0, 0, 0, 1]]))
    places, hit, _ = mesh.ray.intersects_location(np.zeros((rows.size, 3)), rays.reshape(-1, 3), multiple_hits=False)
    large = np.zeros(rows.size)
    large[hit] = np.linalg.norm(places, axis=-1)
    large = large.reshape(rows.shape)
    small, inside = large[height:-height, width:-width], rays[height:-height, width:-width]
    visible = (small > 0) & ((small - depth * np.linalg.norm(inside, axis=-1) <= 15) | (depth == 0))
    boxes = []
    for mask, corner in ((large > 0, (width, height)), (visible, (0, 0))):
        at = np.argwhere(mask)[:, ::-1]
        boxes.append([*(at.min(axis=0) - corner), *np.ptp(at, axis=0)] if visible.any() else [-1] * 4)
    counts = {"px_count_all": (large > 0).sum(), "px_count_valid": ((small > 0) & (depth > 0)).sum()}
    counts |= {"px_count_visib": visible.sum(), "visib_fract": visible.sum() / max((large > 0).sum(), 1)}
    return small > 0, visible, {**counts, "bbox_obj": boxes[0], "bbox_visib": boxes[1]}
