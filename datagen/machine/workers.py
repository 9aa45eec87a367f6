"""Worker processes: the same job in each of them, tasks from one list, no orphan when the parent dies."""

import contextlib
import os
import sys
import types
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

from datagen.disk.errors import HyalineError, WorkerKilledError

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
        HyalineError: what the job or a task raised, in whichever process.
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

    A script that builds at its top level, without `if __name__ == "__main__":`, would start processes without end.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


_job: object = None
"""The job of this worker process."""
_problem: HyalineError | None = None
"""Why this worker has no job."""


def _start_worker(make_job: Callable[..., object], arguments: tuple[object, ...], workers: int) -> None:
    from datagen.machine.mitsuba_variant import num_cores

    global _job, _problem
    die_with(os.getppid())
    try:
        _job = make_job(max(1, num_cores() // workers), *arguments)
    except HyalineError as error:
        # Raised here, it would be a traceback; the first task brings it to the parent.
        _problem = error


def _call_worker(function: Callable[[object, object], None], task: object) -> None:
    if _problem is not None:
        raise _problem
    function(_job, task)


def die_with(parent: int) -> None:
    """Ends this process when the one that started it was killed, instead of writing on beside the next run.

    Args:
        parent: the process id of the parent, who may be gone already.
    """
    import threading
    import time

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
