"""Child processes: modules that get and return arrays, since native code may crash or hang; and pools of workers."""

import contextlib
import functools
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from datagen.disk.errors import HyalineError, WorkerKilledError, naming

ROOT = Path(__file__).resolve().parents[2]
"""The folder that contains these packages."""


_START = """
import resource, runpy, sys
_, hard = resource.getrlimit(resource.RLIMIT_CPU)
resource.setrlimit(resource.RLIMIT_CPU, (hard, hard))
del sys.argv[0]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""
"""Lifts the soft CPU limit that a child would inherit from a confined parent; the child has its own timeout."""


class ChildError(Exception):
    """The process returned nothing; the message is the reason in a few words."""


def run_child(words: list[str], said: BinaryIO, *, timeout_s: float | None = None, **environment: str) -> int:
    """Runs Python with these words until it ends, and returns its exit status; kills its process group in any case.

    The child imports the same packages as this process, and nothing from the working directory.

    Args:
        said: gets what it writes to stderr.

    Raises:
        subprocess.TimeoutExpired: it took too long.
    """
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    paths = [str(ROOT), *(str(Path(path).resolve()) for path in given if path)]
    process = subprocess.Popen(
        [sys.executable, "-P", *words],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), **environment},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=said,
        start_new_session=True,
    )
    try:
        return process.wait(timeout_s)
    finally:
        with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS: the group has ended.
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def arrays_from_child(
    module: str, arrays: Mapping[str, np.ndarray], *, timeout_s: float, words: tuple[str, ...] = ()
) -> dict[str, np.ndarray]:
    """Runs `python -m MODULE IN.npz OUT.npz WORDS` and returns the arrays in OUT.npz.

    Args:
        arrays: the contents of IN.npz.

    Raises:
        ChildError: the process died, took too long, or wrote nothing.
    """
    with tempfile.TemporaryDirectory(prefix="hyaline-child-") as folder:
        source, target, said = (Path(folder) / name for name in ("in.npz", "out.npz", "said"))
        with naming(source):
            np.savez(source, allow_pickle=False, **arrays)
        try:
            with said.open("wb") as file:
                command = ["-c", _START, module, str(source), str(target), *words]
                status = run_child(command, file, timeout_s=timeout_s)
        except subprocess.TimeoutExpired:
            raise ChildError(f"it took more than {timeout_s:.0f} s") from None
        if status < 0:
            raise ChildError(f"it was ended by signal {-status} (9: the system does that where memory runs out)")
        if status != 0 or not target.is_file():
            last = (said.read_text(errors="replace").strip().splitlines() or ["no message"])[-1]
            raise ChildError(f"it ended with status {status}: {last}")
        with np.load(target) as found:
            return dict(found)


Job = TypeVar("Job")
Task = TypeVar("Task")


def in_workers(
    function: Callable[[Job, Task], None],
    tasks: list[Task],
    workers: int,
    make_job: Callable[..., Job],
    arguments: tuple[object, ...],
) -> Iterable[None]:
    """Calls `function` with a job and each task: here, or in spawned processes (a fork would hang torch and Dr.Jit).

    Raises:
        WorkerKilledError: a process was killed; all others have been ended.
    """
    if workers < 1:
        raise HyalineError(f"workers: is {workers}; expected at least 1")
    if workers > 1:
        return _spawned(function, tasks, min(workers, len(tasks)), (make_job, arguments))
    return _here(function, tasks, make_job, arguments)


def _here(
    function: Callable[[Job, Task], None],
    tasks: list[Task],
    make_job: Callable[..., Job],
    arguments: tuple[object, ...],
) -> Iterator[None]:
    from datagen.machine.mitsuba_variant import num_cores

    job = make_job(num_cores(), *arguments)
    for task in tasks:
        yield function(job, task)


def _spawned(
    function: Callable[[Job, Task], None], tasks: list[Task], workers: int, how: tuple[object, ...]
) -> Iterator[None]:
    import multiprocessing
    from concurrent.futures.process import BrokenProcessPool

    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=(workers, *how)) as pool:
        try:
            yield from pool.map(_call_worker, [function] * len(tasks), tasks)
        except BrokenProcessPool:
            raise WorkerKilledError(
                "a worker process was killed (the system does that where memory runs out)"
            ) from None


_how: tuple[Any, ...] = ()
"""How this worker makes its job: the number of workers, the function and its arguments."""


def _start_worker(*how: object) -> None:
    global _how
    _how = how
    die_with(os.getppid())


@functools.cache
def _job() -> object:
    """This worker's job. The first task makes it, since an error of the initializer would print a traceback."""
    from datagen.machine.mitsuba_variant import num_cores

    workers, make_job, arguments = _how
    return make_job(max(1, num_cores() // workers), *arguments)


def _call_worker(function: Callable[[object, object], None], task: object) -> None:
    function(_job(), task)


def die_with(parent: int) -> None:
    """Ends this process when its parent is killed, so that it does not write into the next run's files.

    Args:
        parent: the parent's process id; the parent may have ended already.
    """
    import threading
    import time

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
