"""The logs of a training run, for people to read; no command relies on them.

RUN/metrics.jsonl           a line per evaluation: step, loss (mean since the line before), held_out_psnr,
                            train_psnr
RUN/snapshots/000500.png    at each evaluation: the scored pixels of the held-out views, truth above prediction; 8-bit
                            sRGB
RUN/costs.json              with --costs: time and memory, summed over the sessions of a run

Metrics and snapshots have equal bytes whenever the same run is trained, however often it was stopped; costs differ.
"""

import contextlib
import json
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from datagen.data.images import png_bytes
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, from_json, parse_json
from datagen.disk.storage import commit, read_regular

COSTS, METRICS, SNAPSHOTS = "costs.json", "metrics.jsonl", "snapshots"

MOST_PIXELS = 128
"""Longer side of a view's picture in a snapshot; larger ones are subsampled."""
GAP = 2

Pictures = UInt8[np.ndarray, "view h w 3"]


def write_metrics(run: Path, metrics: list[dict[str, Json]]) -> None:
    """Commits the lines of metrics.jsonl, or deletes it if there are none."""
    if metrics:
        commit(run / METRICS, "".join(json.dumps(line, allow_nan=False) + "\n" for line in metrics).encode())
    else:
        (run / METRICS).unlink(missing_ok=True)


def read_metrics(run: Path) -> list[dict[str, float | None]]:
    """The lines of metrics.jsonl, one per evaluation: step, loss, and PSNR in dB of held-out and of training views."""
    path = run / METRICS
    lines = read_regular(path).splitlines() if path.is_file() else []
    found = []
    for number, line in enumerate(lines, start=1):
        where = f"{path}: line {number}"
        found.append(from_json(dict[str, float | None], parse_json(line, where=where), where=where))
    return found


def write_snapshot(run: Path, step: int, truth: Pictures, predicted: Pictures) -> None:
    """Commits one picture of an evaluation: the true views above the predicted ones, with white gaps."""
    stride = -(-max(truth.shape[1:3]) // MOST_PIXELS)
    both = np.stack([truth, predicted])[:, :, ::stride, ::stride]
    framed = np.pad(both, [(0, 0), (0, 0), (0, GAP), (0, GAP), (0, 0)], constant_values=255)
    rows, views, height, width, _ = framed.shape
    sheet = framed.swapaxes(1, 2).reshape(rows * height, views * width, 3)[:-GAP, :-GAP]
    commit(run / SNAPSHOTS / f"{step:06d}.png", png_bytes(sheet))


@contextlib.contextmanager
def measured(run: Path) -> Iterator[None]:
    """Adds the time and memory that the block takes to the costs of a run, if it has begun by then."""
    seconds, cpu_seconds = time.monotonic(), _cpu_seconds()
    try:
        yield
    finally:
        if (run / "run.json").is_file():
            before = _read_costs(run)
            spent = {
                "seconds": before.get("seconds", 0.0) + time.monotonic() - seconds,
                "cpu_seconds": before.get("cpu_seconds", 0.0) + _cpu_seconds() - cpu_seconds,
            }
            for name, most in _peaks().items():
                spent[name] = max(before.get(name, 0.0), most)
            _write_costs(run, spent)


def add_frames(run: Path, frames: int, seconds: float) -> None:
    """Adds to a run's costs how many test views it predicted a second, loading included."""
    _write_costs(run, {**_read_costs(run), "frames_per_second": frames / seconds})


def _cpu_seconds() -> float:
    """CPU time of this process and of its finished children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def _peaks() -> dict[str, float]:
    """Peak memory of this process, and on its GPU if it uses one."""
    import torch  # Not before: metrics are also read without it.

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    peaks = {"peak_memory_bytes": float(most if sys.platform == "darwin" else 1024 * most)}
    if torch.cuda.is_initialized():
        peaks["peak_gpu_memory_bytes"] = float(torch.cuda.max_memory_allocated())
    return peaks


def _read_costs(run: Path) -> dict[str, float]:
    """The costs so far; empty if there is no readable file."""
    path = run / COSTS
    with contextlib.suppress(HyalineError):
        if path.is_file():
            return from_json(dict[str, float], parse_json(read_regular(path), where=str(path)), where=str(path))
    return {}


def _write_costs(run: Path, costs: dict[str, float]) -> None:
    rounded = {name: round(value, 2) if "second" in name else int(value) for name, value in costs.items()}
    commit(run / COSTS, (json.dumps(rounded, indent=2) + "\n").encode())
