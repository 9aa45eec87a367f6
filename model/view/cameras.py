"""A browser's camera as one of ours, and ours as a browser's: viser looks along +z with +y down, a dataset along -z."""

import math

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.data.cameras import Camera

FLIP = np.diag([1.0, -1.0, -1.0])
"""From OpenCV's axes to OpenGL's, and back."""


def camera_in_window(
    position: Float[np.ndarray, "3"], wxyz: Float[np.ndarray, "4"], fov_y: float, width: int, height: int
) -> Camera:
    """The camera that sees what a window shows, in a picture of so many square pixels.

    Args:
        wxyz: a unit quaternion, world from camera, in OpenCV's convention.
        fov_y: radians, over the window's height.
    """
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = Rotation.from_quat(np.roll(wxyz, -1)).as_matrix() @ FLIP
    world_from_camera[:3, 3] = position
    fov_x = 2 * math.atan(math.tan(fov_y / 2) * width / height)
    return Camera(world_from_camera=world_from_camera, fov_x=fov_x, width=width, height=height)


def window_pose(camera: Camera) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"], float]:
    """Position, quaternion and vertical field of view in radians, as `camera_in_window` takes them."""
    rotation = Rotation.from_matrix(camera.world_from_camera[:3, :3] @ FLIP)
    fov_y = 2 * math.atan(math.tan(camera.fov_x / 2) * camera.height / camera.width)
    return camera.world_from_camera[:3, 3], np.roll(rotation.as_quat(), 1), fov_y


def fitted_size(side: int, window: tuple[int, int]) -> tuple[int, int]:
    """Width and height of a picture whose longer side is `side`, shaped as a window (width, height)."""
    width, height = (max(1, pixels) for pixels in window)
    scale = side / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))
