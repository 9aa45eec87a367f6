"""Child processes: modules that get and return arrays, since native code may crash or hang; and pools of workers."""

import contextlib
import os
import subprocess
import sys
import tempfile
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TypeVar

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


def child_environment() -> dict[str, str]:
    """An environment in which a child imports the same packages as its parent.

    Start the child with -P, which keeps the working directory out of its path.
    """
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    paths = [str(ROOT), *(str(Path(path).resolve()) for path in given if path)]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


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
        source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
        with naming(source):
            np.savez(source, allow_pickle=False, **arrays)
        try:
            answer = subprocess.run(
                [sys.executable, "-P", "-c", _START, module, str(source), str(target), *words],
                env=child_environment(),
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                timeout=timeout_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise ChildError(f"it took more than {timeout_s:.0f} s") from None
        if answer.returncode < 0:
            raise ChildError(
                f"it was ended by signal {-answer.returncode} (9: the system does that where memory runs out)"
            )
        if answer.returncode != 0 or not target.is_file():
            last = (answer.stderr.strip().splitlines() or ["no message"])[-1]
            raise ChildError(f"it ended with status {answer.returncode}: {last}")
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
    if workers == 1:
        return _here(function, tasks, make_job, arguments)
    return _spawned(function, tasks, min(workers, len(tasks)), make_job, arguments)


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
    function: Callable[[Job, Task], None],
    tasks: list[Task],
    workers: int,
    make_job: Callable[..., Job],
    arguments: tuple[object, ...],
) -> Iterator[None]:
    import multiprocessing
    from concurrent.futures.process import BrokenProcessPool

    context = multiprocessing.get_context("spawn")
    start = (make_job, arguments, workers)
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=start) as pool:
        try:
            with _without_main():
                results = pool.map(_call_worker, [function] * len(tasks), tasks)
            yield from results
        except BrokenProcessPool:
            raise WorkerKilledError(
                "a worker process was killed (the system does that where memory runs out)"
            ) from None


@contextlib.contextmanager
def _without_main() -> Iterator[None]:
    """Processes that start in this block do not run the caller's script again, whose `__main__` they do not need.

    Otherwise a script that builds without `if __name__ == "__main__":` would start processes without end.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


_job: object = None
"""This worker's job."""
_problem: HyalineError | None = None
"""Why this worker could not make its job."""


def _start_worker(make_job: Callable[..., object], arguments: tuple[object, ...], workers: int) -> None:
    from datagen.machine.mitsuba_variant import num_cores

    global _job, _problem
    die_with(os.getppid())
    try:
        _job = make_job(max(1, num_cores() // workers), *arguments)
    except HyalineError as error:
        # Raised here, it would print a traceback; the first task raises it in the parent.
        _problem = error


def _call_worker(function: Callable[[object, object], None], task: object) -> None:
    if _problem is not None:
        raise _problem
    function(_job, task)


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
