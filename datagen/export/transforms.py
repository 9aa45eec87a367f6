"""Cameras as NeRF tools read them: the keys of transforms.json that several formats share."""

import math

import numpy as np

from datagen.data.cameras import CONVENTION, Camera
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.export.source import Bounds, ExportView

MAX_SHIFT = 0.05
"""Pixels by which a principal point may miss the picture's middle and still be taken for it."""


def lens_keys(camera: Camera) -> dict[str, Json]:
    """The lens that all views share: angle in radians, focal lengths and principal point in pixels."""
    matrix = camera.intrinsics
    return {
        "camera_angle_x": 2 * math.atan(0.5 * camera.width / float(matrix[0, 0])),
        "fl_x": float(matrix[0, 0]),
        "fl_y": float(matrix[1, 1]),
        "cx": float(matrix[0, 2]),
        "cy": float(matrix[1, 2]),
        "w": camera.width,
        "h": camera.height,
    }


def check_centered(camera: Camera, form: str) -> None:
    """Refuses cameras that readers of a format would take for others: they know the angle of the lens alone.

    Raises:
        HyalineError: the principal point is not in the picture's middle.
    """
    column, row = camera.principal_point
    if max(abs(column - camera.width / 2), abs(row - camera.height / 2)) > MAX_SHIFT:
        raise HyalineError(
            f"--format {form}: its readers take the picture's middle for the principal point, which is {column:g}, "
            f"{row:g} here; export as nerfstudio or colmap"
        )


def bounds_keys(bounds: Bounds) -> dict[str, Json]:
    """What a tool has to be told so that it cuts nothing off: metres along the ray, and a box in world axes."""
    return {"near": bounds.near, "far": bounds.far, "aabb": [list(bounds.low), list(bounds.high)]}


def frame(item: ExportView, file_path: str, **more: Json) -> dict[str, Json]:
    """One view: its picture and its world_from_camera (OpenGL)."""
    matrix = np.asarray(item.view.camera.world_from_camera, np.float64)
    return {"file_path": file_path, "transform_matrix": matrix.tolist(), **more}


__all__ = ["CONVENTION", "bounds_keys", "check_centered", "frame", "lens_keys"]
