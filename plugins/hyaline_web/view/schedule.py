"""The order of pictures for the connected browsers: coarse ones while a camera moves, finer ones when it rests.

viser's cameras look along +z with +y down, a dataset's along -z with +y up.
"""

import dataclasses
import math
import threading
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.data.cameras import Camera

STILL_S = 0.25
"""Seconds without movement after which a camera is at rest."""
MOVING_S = 0.1
"""Longest time to draw a picture while the camera moves."""
SIDES = (32, 64, 128, 256, 512, 768)
"""Pixels of a picture's longer side. Few sizes, because tracers compile a program for each."""
FIRST_RATE = 50_000.0
"""Initial estimate of quick pixels per second."""


@dataclass(kw_only=True, eq=False)
class Pose:
    """The pose of a browser's camera, in viser's convention, and what is still to be drawn for it."""

    position: Float[np.ndarray, "3"]
    wxyz: Float[np.ndarray, "4"]
    fov_y: float
    window: tuple[int, int]
    """Width and height in pixels."""
    moved_at: float = 0.0
    sides: list[int] | None = None
    """The longer sides of the full pictures that are still to be drawn; None before the quick one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Job:
    """One picture to draw for one browser."""

    client: int
    pose: Pose
    """The browser's pose; a later one replaces it."""
    camera: Camera
    is_quick: bool
    """True to draw with one ray per pixel."""


class Schedule:
    """Chooses the next picture: for each pose a quick one, then full ones from the quick one's size to the window's.

    Browsers report from any thread; one thread asks and draws. Times are from one monotonic clock, in seconds.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._poses: dict[int, Pose] = {}
        self._rate = FIRST_RATE

    def move(self, client: int, pose: Pose, now: float) -> None:
        """Records a browser's new camera."""
        with self._lock:
            self._poses[client] = dataclasses.replace(pose, moved_at=now, sides=None)

    def forget(self, client: int) -> None:
        """Removes a browser that has disconnected."""
        with self._lock:
            self._poses.pop(client, None)

    def redraw(self) -> None:
        """Marks every picture as outdated, because the scene has changed."""
        for client, pose in list(self._poses.items()):
            self.move(client, pose, pose.moved_at)

    @property
    def is_watched(self) -> bool:
        """True while a browser is connected."""
        return bool(self._poses)

    def is_wanted(self, job: Job) -> bool:
        """False as soon as the camera has moved on, or another browser waits for its quick picture."""
        is_current = self._poses.get(job.client) is job.pose
        return is_current and (job.is_quick or all(other.sides is not None for other in list(self._poses.values())))

    def next_job(self, now: float) -> Job | None:
        """The picture to draw now, outdated ones first, then the coarsest; None if no browser waits for one."""
        with self._lock:
            waiting = [
                (0 if pose.sides is None else pose.sides[0], client)
                for client, pose in self._poses.items()
                if pose.sides is None or (pose.sides and now - pose.moved_at >= STILL_S)
            ]
            if not waiting:
                return None
            side, client = min(waiting)
            pose = self._poses[client]
            wide, tall = (max(1, pixels) for pixels in pose.window)
            scale = (side or self._quick_side(wide, tall)) / max(wide, tall)
            width, height = max(1, round(wide * scale)), max(1, round(tall * scale))
            camera = camera_in_window(pose.position, pose.wxyz, pose.fov_y, width, height)
            return Job(client=client, pose=pose, camera=camera, is_quick=side == 0)

    def finish(self, job: Job, seconds: float) -> None:
        """Records that a picture was drawn and sent in this time."""
        with self._lock:
            if job.is_quick:
                self._rate = 0.5 * (self._rate + job.camera.width * job.camera.height / max(seconds, 1e-6))
            # Of a pose that was replaced meanwhile, nobody looks at the rest.
            side, most = max(job.camera.width, job.camera.height), max(*job.pose.window, SIDES[0])
            job.pose.sides = [other for other in SIDES if side + (not job.is_quick) <= other <= most]

    def _quick_side(self, width: int, height: int) -> int:
        """The longest of SIDES that fits the window and probably takes no longer than MOVING_S to draw."""
        longest = (self._rate * MOVING_S * max(width, height) / min(width, height)) ** 0.5
        return max((side for side in SIDES if side <= min(longest, max(width, height))), default=SIDES[0])


FLIP = np.diag([1.0, -1.0, -1.0])
"""Converts between OpenCV's and OpenGL's axes, in both directions."""


def camera_in_window(
    position: Float[np.ndarray, "3"], wxyz: Float[np.ndarray, "4"], fov_y: float, width: int, height: int
) -> Camera:
    """The camera of a browser's window, for a picture of this many square pixels.

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
