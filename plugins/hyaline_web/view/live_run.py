"""Pictures of a run in its current state, trained or still training, and their order for the connected browsers: coarse
ones while a camera moves, finer ones when it rests.

viser's cameras look along +z with +y down, a dataset's along -z with +y up.
"""

import contextlib
import dataclasses
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor

from datagen.data.cameras import Camera
from datagen.data.dataset import Dataset
from model.methods.renderer import Renderer
from model.run.predict import check_draws_cameras, check_parameters, load_renderer, predict_pixels
from model.run.run_folder import (
    CHECKPOINT,
    WEIGHTS,
    TrainConfig,
    check_state_of,
    check_trained_on,
)
from model.state import load_state

Picture = UInt8[np.ndarray, "h w 3"]


class MovedOn(Exception):
    """The current picture is no longer needed."""


class LiveRun:
    """Renders any camera with a run's newest weights, without writing to the run's folder.

    A training run writes a checkpoint at least every minute; `refresh` reads the newest one.
    """

    def __init__(self, folder: Path, config: TrainConfig, dataset: Dataset, *, device: torch.device) -> None:
        """Checks the run; its weights are only read by `refresh`."""
        check_draws_cameras(folder, config)
        self.folder, self.config, self.dataset, self.device = folder, config, dataset, device
        self.inputs = check_trained_on(folder, config, dataset)
        self.step = 0
        """Training steps of the current weights; 0: no weights yet."""
        self._renderer: Renderer | None = None
        self._read: tuple[str, int, int] | None = None
        """Name, size and time of the last file read."""
        self._is_wanted: Callable[[], bool] = lambda: True

    @property
    def is_trained(self) -> bool:
        """True if the run has its final weights."""
        return (self.folder / WEIGHTS).is_file()

    @property
    def status(self) -> str:
        """The run's progress in one line."""
        if not self.step:
            return "no checkpoint yet"
        return f"step {self.step:,} of {self.config.steps:,}"

    def refresh(self) -> bool:
        """Reads the newest weights unless they are the current ones; True if they are new."""
        newest = self._newest()
        if newest is None or newest[0] == self._read:
            return False
        self._read, path = newest
        renderer, step = self._load(path)
        for part in renderer.modules():
            part.register_forward_pre_hook(self._check_wanted)
        self._renderer, self.step = renderer.to(self.device).eval(), step
        return True

    def draw(self, camera: Camera, *, is_quick: bool, is_wanted: Callable[[], bool] = lambda: True) -> Picture | None:
        """The picture through a camera, 8-bit sRGB; None if there are no weights yet.

        Args:
            is_quick: use one ray per pixel.
            is_wanted: called repeatedly while the picture is drawn.

        Raises:
            MovedOn: `is_wanted` returned False.
            HyalineError: a size that the method cannot draw.
        """
        if self._renderer is None:
            return None
        net = self.config.net.hurried() if is_quick else self.config.net
        self._is_wanted = is_wanted
        pixels = net.load_cameras(self.inputs, camera.alone)
        return predict_pixels(self._renderer, pixels.to(self.device)).reshape(camera.height, camera.width, 3)

    def _newest(self) -> tuple[tuple[str, int, int], Path] | None:
        for name in (WEIGHTS, CHECKPOINT):
            with contextlib.suppress(FileNotFoundError):
                found = (self.folder / name).stat()
                return (name, found.st_size, found.st_mtime_ns), self.folder / name
        return None

    def _load(self, path: Path) -> tuple[Renderer, int]:
        if path.name == WEIGHTS:
            return load_renderer(self.folder, self.config, self.dataset), self.config.steps
        state = load_state(path)
        check_state_of(state, self.config, self.inputs, path=path)
        renderer = self.config.net.build(self.inputs)
        check_parameters(renderer.state_dict(), state.get("renderer"), where=str(path))
        renderer.load_state_dict(cast(dict[str, Tensor], state["renderer"]))
        return renderer, cast(int, state["step"])

    def _check_wanted(self, *_: object) -> None:
        """Called before every module's forward pass, many times per picture."""
        if not self._is_wanted():
            raise MovedOn


# The order of pictures

STILL_S = 0.25
"""Seconds without movement after which a camera is at rest."""
SIDES = (64, 128, 256, 512, 768)
"""Pixels of a picture's longer side; the first while the camera moves. Few sizes: each takes a program."""


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
    """Chooses the next picture: for each pose a quick one, then full ones from its size to the window's.

    Browsers report from any thread; one thread asks and draws. Times are from one monotonic clock, in seconds.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._poses: dict[int, Pose] = {}

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
        """False as soon as the camera has moved on."""
        return self._poses.get(job.client) is job.pose

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
            scale = (side or SIDES[0]) / max(wide, tall)
            width, height = max(1, round(wide * scale)), max(1, round(tall * scale))
            camera = camera_in_window(pose.position, pose.wxyz, pose.fov_y, width, height)
            return Job(client=client, pose=pose, camera=camera, is_quick=side == 0)

    def finish(self, job: Job) -> None:
        """Records that a picture was drawn and sent."""
        side, most = max(job.camera.width, job.camera.height), max(*job.pose.window, SIDES[0])
        job.pose.sides = [other for other in SIDES if side + (not job.is_quick) <= other <= most]


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
