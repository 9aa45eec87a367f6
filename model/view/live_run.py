"""A run as it is now, trained or still training: its newest weights, read from its folder, and what they draw."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from datagen.data.cameras import Camera
from datagen.data.dataset import Dataset
from model.methods.renderer import Renderer
from model.run.checkpoint import load_state
from model.run.predict import check_draws_cameras, check_parameters, load_renderer, predict_pixels
from model.run.run_folder import (
    CHECKPOINT,
    PREVIOUS_CHECKPOINT,
    WEIGHTS,
    TrainConfig,
    check_state_of,
    check_trained_on,
    read_metrics,
)

Picture = UInt8[np.ndarray, "h w 3"]


class MovedOn(Exception):
    """The picture that is being drawn is no longer wanted."""


class LiveRun:
    """Draws what any camera sees by a run's newest weights. It writes nothing into the run's folder.

    A run that trains leaves a checkpoint every minute at least; `refresh` reads the newest one.
    """

    def __init__(self, folder: Path, config: TrainConfig, dataset: Dataset, *, device: torch.device) -> None:
        """Nothing is read of the weights yet.

        Raises:
            HyalineError: trained on other data, or of a method that draws the views of its dataset alone.
        """
        check_draws_cameras(folder, config)
        self.folder, self.config, self.dataset, self.device = folder, config, dataset, device
        self.inputs = check_trained_on(folder, config, dataset)
        self.step = 0
        """Steps that the weights at hand have made; 0: there are none yet."""
        self._renderer: Renderer | None = None
        self._read: tuple[str, int, int] | None = None
        """Name, size and time of the file that was read last."""
        self._is_wanted: Callable[[], bool] = lambda: True

    @property
    def is_trained(self) -> bool:
        """True when the run has its final weights: nobody trains it."""
        return (self.folder / WEIGHTS).is_file()

    @property
    def status(self) -> str:
        """How far the run is, in one line."""
        if not self.step:
            return "no checkpoint yet"
        scores = [line["held_out_psnr"] for line in read_metrics(self.folder) if (line["step"] or 0) <= self.step]
        score = f", held out {scores[-1]:.2f} dB" if scores and scores[-1] is not None else ""
        return f"step {self.step:,} of {self.config.steps:,}{score}"

    def refresh(self) -> bool:
        """Reads the newest weights, if they are others than those at hand; True when they are.

        Raises:
            HyalineError: damaged weights, or those of another configuration.
        """
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
        """What a camera sees, 8-bit sRGB; None where there are no weights yet.

        Args:
            is_quick: with one ray a pixel.
            is_wanted: asked again and again while the picture is drawn.

        Raises:
            MovedOn: the picture is no longer wanted.
            HyalineError: a size that the method cannot draw.
        """
        if self._renderer is None:
            return None
        net = self.config.net.hurried() if is_quick else self.config.net
        with self._wanting(is_wanted):
            pixels = net.load_cameras(self.inputs, camera.alone)
            return predict_pixels(self._renderer, pixels.to(self.device)).reshape(camera.height, camera.width, 3)

    def _newest(self) -> tuple[tuple[str, int, int], Path] | None:
        for name in (WEIGHTS, CHECKPOINT, PREVIOUS_CHECKPOINT):
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

    @contextlib.contextmanager
    def _wanting(self, is_wanted: Callable[[], bool]) -> Iterator[None]:
        before, self._is_wanted = self._is_wanted, is_wanted
        try:
            yield
        finally:
            self._is_wanted = before

    def _check_wanted(self, *_: object) -> None:
        """Called before every part of a network computes, which is many times a picture."""
        if not self._is_wanted():
            raise MovedOn
