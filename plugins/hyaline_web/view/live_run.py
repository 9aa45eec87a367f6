"""A run in its current state, trained or still training: its newest weights, and pictures rendered with them."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from datagen.data.cameras import Camera
from datagen.data.dataset import Dataset
from model.methods.renderer import Renderer
from model.run.logs import read_metrics
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
        scores = [line["held_out_psnr"] for line in read_metrics(self.folder) if (line["step"] or 0) <= self.step]
        score = f", held out {scores[-1]:.2f} dB" if scores and scores[-1] is not None else ""
        return f"step {self.step:,} of {self.config.steps:,}{score}"

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
