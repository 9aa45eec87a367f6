"""What training leaves for people to watch beside its metrics: snapshots of held-out views, TensorBoard's events."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from datagen.terminal.preview import preview
from model.run.costs import Meter
from model.run.events import Events
from model.run.snapshots import snapshot, write_snapshot


@dataclass(frozen=True, kw_only=True)
class LogChoices:
    """Which logs a run leaves; none of them changes another byte of it."""

    snapshots: bool = True
    """A picture of the held-out views at each evaluation."""
    tensorboard: bool = False
    """Event files for TensorBoard."""
    costs: Meter | None = None
    """Time and memory that it took since then; None: it is not told."""
    preview: bool = False
    """Thumbnails of the held-out views in the terminal, at each evaluation."""


class Logs:
    """The logs of one training."""

    def __init__(self, run: Path, choices: LogChoices, *, first_step: int) -> None:
        self._run, self._choices = run, choices
        self._events = Events(run, first_step=first_step) if choices.tensorboard else None

    def add_loss(self, step: int, loss: float) -> None:
        if self._events is not None:
            self._events.add_loss(step, loss)

    def add_evaluation(
        self,
        step: int,
        score: float | None,
        truth: UInt8[np.ndarray, "view h w 3"],
        predicted: UInt8[np.ndarray, "view h w 3"],
    ) -> None:
        """The held-out PSNR in dB (None without held-out views) and the held-out views after a step."""
        picture = snapshot(truth, predicted) if len(truth) else None
        if picture is not None and self._choices.snapshots:
            write_snapshot(self._run, step, picture)
        if self._choices.preview:
            told = "" if score is None else f", {score:.2f} dB"
            shown = [np.concatenate(pair) for pair in zip(truth, predicted, strict=True)]
            preview(shown, f"held-out views after step {step:,}{told}: truth above prediction")
        if self._events is not None:
            self._events.add_evaluation(step, score, picture)

    def close(self) -> None:
        if self._choices.costs is not None:
            self._choices.costs.add_to(self._run)
        if self._events is not None:
            self._events.close()
