"""Cameras as NeRF tools read them: the keys of transforms.json that several formats share."""

import math

import numpy as np

from datagen.data.cameras import CONVENTION, Camera
from datagen.disk.records import Json
from datagen.export.source import Bounds, ExportView


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


def bounds_keys(bounds: Bounds) -> dict[str, Json]:
    """What a tool has to be told so that it cuts nothing off: metres along the ray, and a box in world axes."""
    return {"near": bounds.near, "far": bounds.far, "aabb": [list(bounds.low), list(bounds.high)]}


def frame(item: ExportView, file_path: str, **more: Json) -> dict[str, Json]:
    """One view: its picture and its world_from_camera (OpenGL)."""
    matrix = np.asarray(item.view.camera.world_from_camera, np.float64)
    return {"file_path": file_path, "transform_matrix": matrix.tolist(), **more}


__all__ = ["CONVENTION", "bounds_keys", "frame", "lens_keys"]
