"""Owns sweeps: trains the runs of an experiment one after the other, each in a process of its own, one a device.

Nothing is kept about a sweep: a run's own folder says what is finished. So a sweep that was stopped or killed goes on
when it is started again, and ends in the same bytes as one that was not.
"""

import os
import queue
import shlex
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from datagen.command import say
from datagen.errors import HyalineError
from model.experiment import Experiment

CHILD = "from datagen.workers import die_with; die_with({parent}); from model.cli import main; main()"
"""`model`, which ends when the sweep is killed: else it would still be writing when the sweep is started again."""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A run that was not finished."""

    command: str
    reason: str
    """The last error that it told, or the signal that ended it."""


def command_line(arguments: Sequence[str]) -> str:
    """What a person would type for one run of an experiment."""
    return shlex.join(["model", "train", *arguments, "--resume"])


def run_experiment(experiment: Experiment, *, devices: Sequence[str | None]) -> tuple[Failure, ...]:
    """Trains every run that is not finished, and goes on past those that fail.

    Args:
        devices: one process runs on each at a time; None stands for the CPU.

    Returns:
        The runs that failed, in the experiment's order.
    """
    free: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    for device in devices:
        free.put(device)
    living: set[subprocess.Popen[str]] = set()
    total = len(experiment.runs)

    def one_run(place: int) -> Failure | None:
        device = free.get()
        try:
            return _train_in_child(experiment.runs[place], f"[{place + 1}/{total}]", device, living)
        finally:
            free.put(device)

    with ThreadPoolExecutor(len(devices)) as pool:
        try:
            results = list(pool.map(one_run, range(total)))
        except BaseException:
            # Ctrl-C: what waits never starts, what runs is told to stop, and the pool waits for it.
            pool.shutdown(wait=False, cancel_futures=True)
            for child in tuple(living):
                child.terminate()
            raise
    return tuple(failure for failure in results if failure is not None)


def find_devices() -> tuple[str | None, ...]:
    """A name for each CUDA device, as CUDA_VISIBLE_DEVICES takes it; (None,) where there is only the CPU."""
    import torch

    count = torch.cuda.device_count()
    if count == 0:
        return (None,)
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    return tuple(visible.split(",")[:count] if visible else map(str, range(count)))


def raise_failures(experiment: Experiment, failures: Sequence[Failure]) -> None:
    """Tells how many runs are finished, and why the others are not.

    Raises:
        HyalineError: a run failed.
    """
    total = len(experiment.runs)
    say(f"sweep {experiment.name}: {total - len(failures)} of {total} runs are finished")
    for failure in failures:
        say(f"failed: {failure.command}: {failure.reason}")
    if failures:
        raise HyalineError(
            f"sweep {experiment.name}: {len(failures)} of {total} runs failed, as the lines above say; "
            "mend that and start the same sweep again, which goes on"
        )


def _train_in_child(
    arguments: Sequence[str], place: str, device: str | None, living: set[subprocess.Popen[str]]
) -> Failure | None:
    """Runs `model train` to its end, its words passed on behind `place`."""
    command = command_line(arguments)
    say(f"{place} {command}" + ("" if device is None else f" (CUDA device {device})"))
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD.format(parent=os.getpid()), "train", *arguments, "--resume"],
        env=os.environ if device is None else os.environ | {"CUDA_VISIBLE_DEVICES": device},
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    )
    living.add(child)
    assert child.stderr is not None
    last = error = ""
    for line in child.stderr:
        last = line.strip() or last
        error = last if last.startswith("error: ") else error
        if not last.startswith("next: "):
            say(f"{place} {line.rstrip()}")
    status = child.wait()
    living.discard(child)
    if status == 0:
        return None
    ended = f"ended by signal {-status}" if status < 0 else f"exit status {status}"
    return Failure(
        command=command, reason=error.removeprefix("error: ") or f"{ended}; it said last: {last or 'nothing'}"
    )
