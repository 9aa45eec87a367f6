"""Making cameras: from another program's intrinsics, and on a circle around a point."""

import dataclasses
import math

import numpy as np
from jaxtyping import Float, Real

from datagen.data.cameras import Camera, look_at
from datagen.data.cameras import Cameras as Cameras
from datagen.data.config import MAX_VIEWS
from datagen.disk.errors import HyalineError, shown
from datagen.disk.records import checked


@checked
def camera_from_intrinsics(
    world_from_camera: Float[np.ndarray, "4 4"], intrinsics: Real[np.ndarray, "3 3"], width: int, height: int
) -> Camera:
    """The camera with a matrix of intrinsics in pixels, as OpenCV writes them.

    >>> import numpy as np
    >>> matrix = look_at((2.0, 0.0, 1.0), (0.0, 0.0, 0.3))
    >>> camera = camera_from_intrinsics(matrix, np.array([[100, 0, 30.5], [0, 100, 24], [0, 0, 1]]), 64, 48)
    >>> bool(np.allclose(camera.intrinsics, [[100, 0, 30.5], [0, 100, 24], [0, 0, 1]]))
    True

    Args:
        world_from_camera: metres, OpenGL convention (+x right, +y up, the camera looks along -z); a matrix of OpenCV's
            convention times `diag(1, -1, -1, 1)`.
        intrinsics: focal lengths and principal point in pixels.
        width: picture width in pixels.
        height: picture height in pixels.

    Raises:
        HyalineError: pixels that are not square, or an invalid camera.
    """
    (focal_x, skew, center_x), (below, focal_y, center_y), last = intrinsics.astype(np.float64)
    if below != 0 or (last != (0, 0, 1)).any():
        raise HyalineError(
            f"intrinsics: are {shown(intrinsics.tolist())}; expected zeros below the diagonal and 1 as the last number"
        )
    if not math.isclose(focal_x, focal_y, rel_tol=1e-4) or abs(skew) > 1e-4 * abs(focal_x):
        raise HyalineError(
            f"intrinsics: focal lengths {focal_x:g}, {focal_y:g} and skew {skew:g}; expected square "
            "pixels: equal focal lengths and no skew"
        )
    return Camera(
        world_from_camera=world_from_camera,
        fov_x=2 * math.atan2(0.5 * width, focal_x),
        width=width,
        height=height,
        center=None if (center_x, center_y) == (0.5 * width, 0.5 * height) else (float(center_x), float(center_y)),
    )


@checked
def orbit(start: Camera, target: tuple[float, float, float], count: int, *, turn_deg: float = 360.0) -> list[Camera]:
    """Cameras on a level circle around a point, evenly spaced, each looking at it; the first at `start`.

    >>> from hyaline import open_dataset
    >>> start = open_dataset("glass_table").view("train", 0).camera
    >>> cameras = orbit(start, (0.0, 0.0, 0.2), count=24)
    >>> len(cameras), cameras[6].width == start.width
    (24, True)

    Args:
        start: gives the first position, the lens and the picture's size.
        target: metres; not straight above or below `start`.
        count: number of cameras; the last is one step short of `turn_deg`, so that a full turn loops.
        turn_deg: counter-clockwise as seen from above.
    """
    if not 1 <= count <= MAX_VIEWS:
        raise HyalineError(f"count: is {count}; expected 1 to {MAX_VIEWS:,}")
    center = np.array(target, np.float64)
    offset = start.world_from_camera[:3, 3] - center
    cameras = []
    for angle in np.arange(count) * math.radians(turn_deg) / count:
        sin, cos = math.sin(angle), math.cos(angle)
        turned = np.array([cos * offset[0] - sin * offset[1], sin * offset[0] + cos * offset[1], offset[2]])
        cameras.append(dataclasses.replace(start, world_from_camera=look_at(center + turned, center)))
    return cameras
