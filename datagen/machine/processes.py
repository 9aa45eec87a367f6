"""Child processes: for native code, which may crash or hang; for untrusted files; and pools of workers.

A file is read in a child with limits on memory and CPU time. Whatever it does to its reader (a loop, a crash, 60 GB, an
unexpected exception) ends only that process and becomes one HyalineError here.
"""

import contextlib
import functools
import multiprocessing
import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, TypeVar

import numpy as np

from datagen.disk.errors import HyalineError, WorkerKilledError, naming
from datagen.terminal.command import say

ROOT = Path(__file__).resolve().parents[2]
"""The folder that contains these packages."""


_START = """
import resource, runpy, sys
limit, (_, hard) = int(sys.argv[1]), resource.getrlimit(resource.RLIMIT_CPU)
resource.setrlimit(resource.RLIMIT_CPU, (limit if hard < 0 else min(limit, hard), hard))
del sys.argv[:2]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""
"""Replaces the soft CPU limit that a child would inherit from a confined parent by its own."""


def num_cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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


def arrays_from_child(module: str, arrays: Mapping[str, np.ndarray], *, cpu_s: int) -> dict[str, np.ndarray]:
    """Runs `python -m MODULE IN.npz OUT.npz` for at most `cpu_s` CPU seconds and returns the arrays in OUT.npz.

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
                command = ["-c", _START, str(cpu_s), module, str(source), str(target)]
                status = run_child(command, file, timeout_s=10 * cpu_s)  # Others may have the cores.
        except subprocess.TimeoutExpired:
            raise ChildError(f"it took more than {10 * cpu_s} s") from None
        if status == -signal.SIGXCPU:
            raise ChildError(f"it took more than {cpu_s} CPU seconds")
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

    Args:
        make_job: makes the job of a process from the number of threads that it may use and `arguments`.

    Raises:
        WorkerKilledError: a process was killed; all others have been ended.
    """
    if workers < 1:
        raise HyalineError(f"workers: is {workers}; expected at least 1")
    if min(workers, len(tasks)) > 1:
        return _spawned(function, tasks, min(workers, len(tasks)), make_job, arguments)
    job = make_job(num_cores(), *arguments)
    return (function(job, task) for task in tasks)


def _spawned(
    function: Callable[..., None], tasks: list[Task], workers: int, make_job: Callable[..., Job], arguments: tuple
) -> Iterator[None]:
    context = multiprocessing.get_context("spawn")
    how = os.getpid(), make_job, max(1, num_cores() // workers), *arguments
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=how) as pool:
        others = set(multiprocessing.active_children())
        # As workers start, they would run a script that lacks `if __name__ == "__main__"` again.
        main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
        try:
            futures = [pool.submit(_call_worker, function, task) for task in tasks]
        finally:
            sys.modules["__main__"] = main
        try:
            yield from (future.result() for future in futures)
        except BrokenProcessPool:
            raise WorkerKilledError(
                "a worker process was killed (the system does that where memory runs out)"
            ) from None
        except BaseException:
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()  # The pool would let each finish a task or two.
            raise


_how: tuple[Any, ...] = ()
"""How this worker makes its job: a function and its arguments."""


def _start_worker(parent: int, *how: object) -> None:
    global _how
    _how = how
    die_with(parent)


@functools.cache
def _job() -> object:
    """This worker's job. The first task makes it, since an error of the initializer would print a traceback."""
    make_job, *arguments = _how
    return make_job(*arguments)


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


CPU_S = 8
"""CPU seconds allowed before anything is read; starting takes half a second."""
MEMORY = 2_000_000_000
"""Bytes of address space allowed before anything is read; imports and libraries take a quarter."""
CPU_S_PER_BYTE = 3e-5
"""Reading a mesh from text takes 5e-7, compressed XML 1e-5."""
MEMORY_PER_BYTE = 24
CPU_S_PER_TRIANGLE = 5e-4
"""Repairing, mapping and checking one takes 1e-4."""
MEMORY_PER_TRIANGLE = 1500


@contextlib.contextmanager
def confined(function: Callable[..., None], *arguments: object, where: str) -> Iterator[Path]:
    """Runs `function(folder, *arguments)` in a child process and yields the folder, which is deleted after the block.

    Function and arguments are pickled for the child; results are never unpickled. If the block is left early, even by
    a signal, the child and all its descendants are killed.

    Args:
        function: a module's top-level function, which writes into the folder; it calls `allow_file` and
            `allow_triangles` for what it reads.
        where: the file, as named in errors.
    """
    with tempfile.TemporaryDirectory(prefix="hyaline-reader-", ignore_cleanup_errors=True) as scratch:
        folder = Path(scratch)
        with naming(folder):
            (folder / "answer").mkdir()
            (folder / "temporary").mkdir()
            (folder / "call").write_bytes(pickle.dumps((function, arguments, where, CPU_S)))
        status = _run(folder)
        end = folder / "end.txt"
        if status != 0 or not end.is_file():
            raise HyalineError(f"{where}: {_met(status)}; it is damaged, or too large: export it again, smaller")
        for line in (folder / "said").read_text(errors="replace").splitlines():
            say(line)
        if error := end.read_text(errors="replace"):
            raise HyalineError(error)
        yield folder / "answer"


def _run(folder: Path) -> int:
    """Runs the child process and returns its exit status."""
    with (folder / "said").open("wb") as said:
        return run_child(
            ["-m", "datagen.machine.processes", str(folder), str(os.getpid())],
            said,
            TMPDIR=str(folder / "temporary"),
            # Each thread of a pool reserves address space.
            OPENBLAS_NUM_THREADS="1",
            OMP_NUM_THREADS="1",
            MALLOC_ARENA_MAX="2",
        )


def _met(status: int) -> str:
    if status == -signal.SIGXCPU:
        return "reading it took too much CPU time"
    if status < 0:
        return f"its reader was ended by {signal.Signals(-status).name}"
    return f"its reader ended with status {status} and no answer"


# Inside the process

_is_confined = False


def allow_file(size: int) -> None:
    """Raises this process's limits by the CPU time and memory that reading a file of this many bytes takes."""
    _allow(CPU_S_PER_BYTE * size, MEMORY_PER_BYTE * size)


def allow_triangles(count: int) -> None:
    """Raises this process's limits by what making a scene of these triangles takes."""
    _allow(CPU_S_PER_TRIANGLE * count, MEMORY_PER_TRIANGLE * count)


def _allow(cpu_s: float, memory: float) -> None:
    if _is_confined:
        for what, more in ((resource.RLIMIT_CPU, cpu_s), (resource.RLIMIT_AS, memory)):
            _limit(what, resource.getrlimit(what)[0] + round(more + 0.5))


def _limit(what: int, limit: int) -> None:
    _, hard = resource.getrlimit(what)
    with contextlib.suppress(ValueError, OSError):  # macOS cannot limit address space.
        resource.setrlimit(what, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def _main(folder: Path, parent: int) -> None:
    global _is_confined
    function, arguments, where, cpu_s = pickle.loads((folder / "call").read_bytes())
    die_with(parent)
    _is_confined = True
    _limit(resource.RLIMIT_CPU, cpu_s)
    _limit(resource.RLIMIT_AS, MEMORY)
    end = ""
    try:
        function(folder / "answer", *arguments)
    except HyalineError as error:
        end = str(error)
    except MemoryError:
        memory = resource.getrlimit(resource.RLIMIT_AS)[0] / 1e9
        end = f"{where}: needs more than {memory:.1f} GB of memory to be read; make it smaller, or split it"
    # Libraries raise all kinds of exceptions on broken files.
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        end = f"{where}: cannot be read ({reason[:200]}); the file is damaged, export it again"
    (folder / "end.txt").write_text(end)


if __name__ == "__main__":
    # `allow_file` has to find the limits in the module that others import.
    from datagen.machine import processes as this

    this._main(Path(sys.argv[1]), int(sys.argv[2]))
