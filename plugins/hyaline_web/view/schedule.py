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
MOVING_S, STANDING_S, FINEST_S = 0.1, 1.0, 20.0
"""Longest time to draw a picture: a quick one while the camera moves, a quick one at rest, and any other."""
SIDES = (32, 48, 64, 96, 128, 192, 256, 384, 512, 768)
"""Pixels of a picture's longer side. Few sizes, because tracers compile a program for each."""
FIRST_RATE, FEWER = 50_000.0, 16
"""Initial estimates: quick pixels per second, and how many times slower full ones are."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """The pose of a browser's camera, in viser's convention, and its window size."""

    position: Float[np.ndarray, "3"]
    wxyz: Float[np.ndarray, "4"]
    fov_y: float
    window: tuple[int, int]
    """Width and height in pixels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Job:
    """One picture to draw for one browser."""

    client: int
    number: int
    """Number of the request; a later one of the same browser replaces it."""
    camera: Camera
    is_quick: bool
    """True to draw with one ray per pixel."""


@dataclass
class _Viewer:
    pose: Pose
    number: int
    moved_at: float
    quick: int = 0
    """The longer side of the finest quick picture drawn for this pose; 0: none yet."""
    drawn: int = 0
    """The same for full pictures."""


class Schedule:
    """Chooses the next picture. Browsers report from any thread; one thread asks and draws.

    Times are from one monotonic clock, in seconds.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._viewers: dict[int, _Viewer] = {}
        self._numbers = 0
        self._rate, self._quick_rate = 0.0, FIRST_RATE

    def move(self, client: int, pose: Pose, now: float) -> None:
        """Records a browser's new camera."""
        with self._lock:
            self._numbers += 1
            self._viewers[client] = _Viewer(pose=pose, number=self._numbers, moved_at=now)

    def forget(self, client: int) -> None:
        """Removes a browser that has disconnected."""
        with self._lock:
            self._viewers.pop(client, None)

    def redraw(self) -> None:
        """Marks every picture as outdated, because the scene has changed."""
        with self._lock:
            for client, viewer in self._viewers.items():
                self._numbers += 1
                self._viewers[client] = dataclasses.replace(viewer, number=self._numbers, quick=0, drawn=0)

    @property
    def is_watched(self) -> bool:
        """True while a browser is connected."""
        return bool(self._viewers)

    def is_wanted(self, job: Job) -> bool:
        """False as soon as the camera has moved on."""
        viewer = self._viewers.get(job.client)
        return viewer is not None and viewer.number == job.number

    def next_job(self, now: float) -> Job | None:
        """The picture to draw now; None if no browser waits for one."""
        with self._lock:
            for client, viewer in sorted(self._viewers.items(), key=_turn):
                if (following := self._following(viewer, now)) is not None:
                    side, is_quick = following
                    pose = viewer.pose
                    width, height = fitted_size(side, pose.window)
                    camera = camera_in_window(pose.position, pose.wxyz, pose.fov_y, width, height)
                    return Job(client=client, number=viewer.number, camera=camera, is_quick=is_quick)
        return None

    def finish(self, job: Job, seconds: float) -> None:
        """Records that a picture was drawn and sent in this time."""
        with self._lock:
            rate = job.camera.width * job.camera.height / max(seconds, 1e-6)
            if job.is_quick:
                self._quick_rate = 0.5 * (self._quick_rate + rate)
            else:
                self._rate = 0.5 * ((self._rate or rate) + rate)
            viewer = self._viewers.get(job.client)
            if viewer is None or viewer.number != job.number:
                return
            side = max(job.camera.width, job.camera.height)
            if job.is_quick:
                viewer.quick = side
            else:
                viewer.drawn = side

    def _following(self, viewer: _Viewer, now: float) -> tuple[int, bool] | None:
        """The longer side of the next picture of a pose, and whether it is a quick one; None: none, or not yet."""
        if not viewer.quick:
            return self._side(viewer, MOVING_S, is_quick=True), True
        if now - viewer.moved_at < STILL_S:
            return None
        longest = self._side(viewer, FINEST_S, is_quick=False)
        if viewer.drawn:
            finer = [side for side in SIDES if viewer.drawn < side <= longest]
            return (finer[min(1, len(finer) - 1)], False) if finer else None
        standing = self._side(viewer, STANDING_S, is_quick=True)
        return (standing, True) if standing > viewer.quick else (min(viewer.quick, longest), False)

    def _side(self, viewer: _Viewer, seconds: float, *, is_quick: bool) -> int:
        """The longest of SIDES that fits the window and takes at most about this long to draw."""
        width, height = (max(1, pixels) for pixels in viewer.pose.window)
        rate = self._quick_rate if is_quick else self._rate or self._quick_rate / FEWER
        longest = (rate * seconds * max(width, height) / min(width, height)) ** 0.5
        return max((side for side in SIDES if side <= min(longest, max(width, height))), default=SIDES[0])


def _turn(item: tuple[int, _Viewer]) -> tuple[bool, int, float]:
    """Sort key of browsers: those with an outdated picture first, then the coarsest, then the longest wait."""
    viewer = item[1]
    return viewer.quick > 0, viewer.drawn, viewer.moved_at


class Budget:
    """Limits this process to a share of one core while another process trains.

    The pause after a piece of work follows from its CPU time, so this process never takes more than that share from
    the training.
    """

    def __init__(self, share: float) -> None:
        self.share = share
        self._ready_at = 0.0

    def spend(self, processor_s: float, now: float) -> None:
        """Records work that took this CPU time and ends now."""
        self._ready_at = now + processor_s * (1 / self.share - 1)

    def is_ready(self, now: float) -> bool:
        return now >= self._ready_at


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


def fitted_size(side: int, window: tuple[int, int]) -> tuple[int, int]:
    """Width and height of a picture with the longer side `side` and the aspect of a window (width, height)."""
    width, height = (max(1, pixels) for pixels in window)
    scale = side / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))
