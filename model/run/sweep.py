"""Sweeps: all runs of an experiment, and the commands before and after them.

Each run is trained in a process of its own, one per device or several side by side, or in a Slurm job of its own. A
sweep keeps no state: the runs' own folders show what is finished, so a sweep that was stopped
or killed continues when it is started again, and ends in the same bytes.
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

from datagen.builder.choices import LaunchChoices
from datagen.disk.errors import HyalineError
from datagen.machine.launch import own_command, run_in_jobs
from datagen.machine.processes import num_cores
from datagen.terminal.command import say, tell
from model.run.experiments import Experiment
from model.settings import RUNS

MODULES = {"hyaline-bench": "hyaline_bench"}
"""Packages of programs that are called differently."""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A run that was not finished."""

    command: str
    reason: str
    """Its last error, or the signal that ended it."""


class Children:
    """The running processes, including any that start while they are being stopped."""

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
    """The command line of one run of an experiment."""
    return shlex.join(["model", "train", *arguments])


def print_experiment(experiment: Experiment) -> None:
    """Prints all command lines."""
    for line in (*experiment.needs, *map(command_line, experiment.runs), *experiment.then):
        tell(line)
    say(f"sweep {experiment.name}: {len(experiment.runs)} runs")


def run_commands(experiment: Experiment, commands: Sequence[str]) -> None:
    """Runs commands of an experiment one after the other; finished work is theirs to skip.

    Raises:
        HyalineError: a command failed.
    """
    for command in commands:
        say(command)
        program, *words = shlex.split(command)
        start = [sys.executable] if program == "python" else own_command(MODULES.get(program, program))
        if status := subprocess.run([*start, *words], stdout=subprocess.DEVNULL, check=False).returncode:
            raise HyalineError(
                f"sweep {experiment.name}: `{command}` ended with status {status}, for the reason above; "
                "fix it and run the same command again to continue"
            )


def run_experiment(experiment: Experiment, *, devices: Sequence[str | None]) -> tuple[Failure, ...]:
    """Makes what the runs need, trains every run that is not finished, and continues past those that fail.

    Args:
        devices: one process runs on each at a time, so a device that is named twice runs two; None is the CPU, whose
            cores its processes share evenly.

    Returns:
        The runs that failed, in the experiment's order.
    """
    free: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    for device in devices:
        free.put(device)
    children = Children()
    total = len(experiment.runs)
    run_commands(experiment, experiment.needs)
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
            # A signal: waiting runs never start, running ones save their work, and the pool waits for them.
            pool.shutdown(wait=False, cancel_futures=True)
            children.stop()
            raise
    return tuple(failure for failure in results if failure is not None)


def train_in_jobs(experiment: Experiment, launch: LaunchChoices) -> tuple[Failure, ...]:
    """As `run_experiment`, with a job for each run; that of a finished run ends at once."""
    run_commands(experiment, experiment.needs)
    jobs = {command_line(words): ["train", *words] for words in experiment.runs}
    failures = run_in_jobs("model", jobs, RUNS / "jobs", launch.launcher, launch.parameters())
    return tuple(Failure(command=command, reason=reason) for command, reason in failures.items())


def find_devices(jobs: int) -> tuple[str | None, ...]:
    """The CUDA devices, named as in CUDA_VISIBLE_DEVICES, or None for the CPU; each repeated `jobs` times."""
    import torch

    if jobs < 1:
        raise HyalineError(f"jobs: is {jobs}; expected at least 1")
    count = torch.cuda.device_count()
    if count == 0:
        return (None,) * jobs
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    return tuple(visible.split(",")[:count] if visible else map(str, range(count))) * jobs


def share_of_cores(jobs: int) -> dict[str, str]:
    """Environment variables that limit the threads of each of several CPU processes; empty for a single one."""
    if jobs < 2:
        return {}
    threads = str(max(1, num_cores() // jobs))
    return {"OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}


def finish(experiment: Experiment, failures: Sequence[Failure]) -> None:
    """Reports how many runs are finished; runs what follows them, or raises a HyalineError if any failed."""
    total = len(experiment.runs)
    say(f"sweep {experiment.name}: {total - len(failures)} of {total} runs are finished")
    for failure in failures:
        say(f"failed: {failure.command}: {failure.reason}")
    if failures:
        raise HyalineError(
            f"sweep {experiment.name}: {len(failures)} of {total} runs failed (see above); "
            "fix them and run the same command again to continue"
        )
    run_commands(experiment, experiment.then)


def _train_in_child(
    arguments: Sequence[str], place: str, environment: Mapping[str, str], children: Children
) -> Failure | None:
    """Runs `model train` to its end, and passes its messages on, prefixed with `place`."""
    command = command_line(arguments)
    device = environment.get("CUDA_VISIBLE_DEVICES")
    say(f"{place} {command}" + ("" if device is None else f" (CUDA device {device})"))
    child = subprocess.Popen(
        [*own_command("model"), "train", *arguments],
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
        command=command, reason=error.removeprefix("error: ") or f"{ended}; its last message: {last or 'none'}"
    )
