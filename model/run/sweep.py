"""Sweeps: the runs of an experiment, each trained in a process of its own, one a device or a few side by side.

Nothing is kept about a sweep: a run's own folder says what is finished. So a sweep that was stopped or killed goes on
when it is started again, and ends in the same bytes as one that was not.
"""

import os
import queue
import shlex
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import num_cores
from datagen.terminal.command import say
from model.run.experiment import Experiment

CHILD = "from datagen.machine.processes import die_with; die_with({parent}); from model.cli import main; main()"
"""`model`, which ends when the sweep is killed: else it would still be writing when the sweep is started again."""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A run that was not finished."""

    command: str
    reason: str
    """The last error that it told, or the signal that ended it."""


class Children:
    """The processes that run, and those that begin while they are told to stop."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._living: set[subprocess.Popen[str]] = set()
        self._is_stopped = False

    def add(self, child: subprocess.Popen[str]) -> None:
        with self._lock:
            self._living.add(child)
            if self._is_stopped:
                child.terminate()

    def remove(self, child: subprocess.Popen[str]) -> None:
        with self._lock:
            self._living.discard(child)

    def stop(self) -> None:
        with self._lock:
            self._is_stopped = True
            for child in self._living:
                child.terminate()


def command_line(arguments: Sequence[str]) -> str:
    """What a person would type for one run of an experiment."""
    return shlex.join(["model", "train", *arguments])


def run_experiment(experiment: Experiment, *, devices: Sequence[str | None]) -> tuple[Failure, ...]:
    """Trains every run that is not finished, and goes on past those that fail.

    Args:
        devices: one process runs on each at a time, so a device that is named twice runs two; None stands for the CPU,
            whose processes share its cores out evenly.

    Returns:
        The runs that failed, in the experiment's order.
    """
    free: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    for device in devices:
        free.put(device)
    children = Children()
    total = len(experiment.runs)
    threads = share_of_cores(devices.count(None))

    def one_run(place: int) -> Failure | None:
        device = free.get()
        environment = threads if device is None else {"CUDA_VISIBLE_DEVICES": device}
        try:
            return _train_in_child(experiment.runs[place], f"[{place + 1}/{total}]", environment, children)
        finally:
            free.put(device)

    with ThreadPoolExecutor(len(devices)) as pool:
        try:
            results = list(pool.map(one_run, range(total)))
        except BaseException:
            # A signal: what waits never starts, what runs saves its work, and the pool waits for it.
            pool.shutdown(wait=False, cancel_futures=True)
            children.stop()
            raise
    return tuple(failure for failure in results if failure is not None)


def find_devices(jobs: int) -> tuple[str | None, ...]:
    """A name for each CUDA device, as CUDA_VISIBLE_DEVICES takes it, or None for the CPU; each as often as jobs.

    Raises:
        HyalineError: there are no jobs.
    """
    import torch

    if jobs < 1:
        raise HyalineError(f"jobs: is {jobs}; expected at least 1")
    count = torch.cuda.device_count()
    if count == 0:
        return (None,) * jobs
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    return tuple(visible.split(",")[:count] if visible else map(str, range(count))) * jobs


def share_of_cores(jobs: int) -> dict[str, str]:
    """What tells each of several processes on the CPU how many threads it has; nothing for a single one."""
    if jobs < 2:
        return {}
    threads = str(max(1, num_cores() // jobs))
    return {"OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}


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
    arguments: Sequence[str], place: str, environment: Mapping[str, str], children: Children
) -> Failure | None:
    """Runs `model train` to its end, its words passed on behind `place`."""
    command = command_line(arguments)
    device = environment.get("CUDA_VISIBLE_DEVICES")
    say(f"{place} {command}" + ("" if device is None else f" (CUDA device {device})"))
    child = subprocess.Popen(
        [sys.executable, "-P", "-c", CHILD.format(parent=os.getpid()), "train", *arguments],
        env=os.environ | environment,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    )
    children.add(child)
    assert child.stderr is not None
    last = error = ""
    for line in child.stderr:
        last = line.strip() or last
        error = last if last.startswith("error: ") else error
        if not last.startswith("next: "):
            say(f"{place} {line.rstrip()}")
    status = child.wait()
    children.remove(child)
    if status == 0:
        return None
    ended = f"ended by signal {-status}" if status < 0 else f"exit status {status}"
    return Failure(
        command=command, reason=error.removeprefix("error: ") or f"{ended}; it said last: {last or 'nothing'}"
    )
