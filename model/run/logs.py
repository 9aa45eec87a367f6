"""The logs of a training run besides its metrics, for people to read; no command relies on them.

RUN/costs.json                           with --costs: time and memory, summed over the sessions of a run
RUN/snapshots/000500.png                 at each evaluation: the scored pixels of the held-out views, truth above
                                         prediction; 8-bit sRGB
RUN/tensorboard/events.out.tfevents.*    with --tensorboard: loss and score as curves, held-out views as pictures

Snapshots have equal bytes whenever the same run is trained, however often it was stopped. Costs and TensorBoard's files
(which contain the time, the host and the process) differ from run to run.
"""

import json
import re
import resource
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from datagen.data.images import png_bytes
from datagen.disk.errors import HyalineError
from datagen.disk.records import from_json, parse_json
from datagen.disk.storage import commit, read_regular

COSTS = "costs.json"
MAX_BYTES = 1 << 16


def _cpu_seconds() -> float:
    """CPU time of this process and of its finished children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


@dataclass(frozen=True, kw_only=True)
class Meter:
    """The clocks at the start of a session."""

    seconds: float = field(default_factory=time.monotonic)
    cpu_seconds: float = field(default_factory=_cpu_seconds)

    def add_to(self, run: Path) -> None:
        """Adds the session that ends now to the run's earlier ones; sessions that were killed are not counted."""
        import torch  # Imported here: the costs are also read without it.

        before = read_costs(run)
        spent = {
            "seconds": before.get("seconds", 0.0) + time.monotonic() - self.seconds,
            "cpu_seconds": before.get("cpu_seconds", 0.0) + _cpu_seconds() - self.cpu_seconds,
            "peak_memory_bytes": max(before.get("peak_memory_bytes", 0.0), _peak_memory()),
        }
        if torch.cuda.is_initialized():
            most = float(torch.cuda.max_memory_allocated())
            spent["peak_gpu_memory_bytes"] = max(before.get("peak_gpu_memory_bytes", 0.0), most)
        _write_costs(run, spent)


def add_frames(run: Path, frames: int, seconds: float) -> None:
    """Adds to a run's costs how many test views it predicted a second, loading included."""
    _write_costs(run, {**read_costs(run), "frames_per_second": frames / seconds})


def _write_costs(run: Path, costs: Mapping[str, float]) -> None:
    rounded = {name: round(value, 2) if "second" in name else int(value) for name, value in costs.items()}
    commit(run / COSTS, (json.dumps(rounded, indent=2) + "\n").encode())


def _peak_memory() -> float:
    """Peak memory of this process in bytes."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(most if sys.platform == "darwin" else 1024 * most)


def read_costs(run: Path) -> dict[str, float]:
    """Time and memory of a run's sessions; empty if there is no readable file."""
    path = run / COSTS
    try:
        found = parse_json(read_regular(path, at_most=MAX_BYTES), where=str(path)) if path.is_file() else {}
        return from_json(dict[str, float], found, where=str(path))
    except HyalineError:
        return {}


SNAPSHOTS = "snapshots"
MOST_PIXELS = 128
"""Longer side of a view's picture; larger ones are subsampled."""
GAP = 2

Picture = UInt8[np.ndarray, "sheet_h sheet_w 3"]


def snapshot(truth: UInt8[np.ndarray, "view h w 3"], predicted: UInt8[np.ndarray, "view h w 3"]) -> Picture:
    """Both rows in one picture, with white gaps."""
    step = -(-max(truth.shape[1:3]) // MOST_PIXELS)
    rows = [_row(pictures[:, ::step, ::step]) for pictures in (truth, predicted)]
    return np.concatenate([rows[0], np.full((GAP, rows[0].shape[1], 3), 255, np.uint8), rows[1]])


def write_snapshot(run: Path, step: int, picture: Picture) -> None:
    """Commits the picture of one evaluation."""
    commit(run / snapshot_path(step), png_bytes(picture))


def snapshot_path(step: int) -> str:
    """Path relative to the run's folder."""
    return f"{SNAPSHOTS}/{step:06d}.png"


def list_snapshots(run: Path, *, evaluate_every: int, steps: int) -> list[str]:
    """The existing pictures that such a run makes, by path relative to its folder."""
    found = []
    for path in sorted((run / SNAPSHOTS).glob("*.png")):
        step = int(path.stem) if re.fullmatch("[0-9]{6,12}", path.stem) else 0
        is_evaluated = 0 < step <= steps and (step % evaluate_every == 0 or step == steps)
        if is_evaluated and snapshot_path(step) == f"{SNAPSHOTS}/{path.name}":
            found.append(snapshot_path(step))
    return found


def _row(pictures: UInt8[np.ndarray, "view h w 3"]) -> Picture:
    gap = np.full((pictures.shape[1], GAP, 3), 255, np.uint8)
    parts = [part for picture in pictures for part in (picture, gap)]
    return np.concatenate(parts[:-1], axis=1)


EVENTS = "tensorboard"
EVENT_FILES = "events.out.tfevents.*"
LOSS_EVERY = 10
"""Steps between two points of the loss."""


class Events:
    """TensorBoard's event files of a training."""

    def __init__(self, run: Path, *, first_step: int) -> None:
        """Hides the points after `first_step` that a stopped run has left.

        Raises:
            ModuleNotFoundError: TensorBoard is not installed.
        """
        from torch.utils.tensorboard.writer import SummaryWriter

        self._writer = SummaryWriter(str(run / EVENTS), purge_step=first_step + 1)

    def add_loss(self, step: int, loss: float) -> None:
        if step % LOSS_EVERY == 0:
            self._writer.add_scalar("loss", loss, step)

    def add_evaluation(self, step: int, score: float, picture: Picture) -> None:
        """A held-out PSNR in dB, and the picture of the held-out views."""
        self._writer.add_scalar("held-out PSNR (dB)", score, step)
        self._writer.add_image("held-out views", picture, step, dataformats="HWC")
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


def require_tensorboard() -> None:
    """Fails early if TensorBoard is not installed.

    Raises:
        ModuleNotFoundError: it is not.
    """
    import tensorboard  # noqa: F401  # pyright: ignore[reportUnusedImport]


def list_events(run: Path) -> list[str]:
    """The event files of a run, by path relative to its folder."""
    return sorted(path.relative_to(run).as_posix() for path in (run / EVENTS).glob(EVENT_FILES))


@dataclass(frozen=True, kw_only=True)
class LogChoices:
    """The logs of a run; none of them changes other files."""

    snapshots: bool = True
    """A small picture of the held-out views at each evaluation."""
    tensorboard: bool = False
    """Event files for TensorBoard."""
    costs: Meter | None = None
    """Record time and memory since then; None: don't."""


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
        score: float,
        truth: UInt8[np.ndarray, "view h w 3"],
        predicted: UInt8[np.ndarray, "view h w 3"],
    ) -> None:
        """The held-out PSNR in dB and the scored pixels of the held-out views after a step."""
        picture = snapshot(truth, predicted)
        if self._choices.snapshots:
            write_snapshot(self._run, step, picture)
        if self._events is not None:
            self._events.add_evaluation(step, score, picture)

    def close(self) -> None:
        if self._choices.costs is not None:
            self._choices.costs.add_to(self._run)
        if self._events is not None:
            self._events.close()
