"""Runs a function in a child process with limits on memory and time, to read untrusted files.

Whatever a file does to its reader (a hang, a crash, 60 GB, an unexpected exception) ends only that process and becomes
one HyalineError here. The function returns its result as files in a scratch folder.
"""

import contextlib
import json
import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from datagen.disk.errors import HyalineError, naming
from datagen.machine.processes import child_environment, die_with
from datagen.terminal.command import say

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
PATIENCE = 10
"""Seconds of wall time per second of CPU time, since other processes use the CPU, too."""
UNWRAPPED_A_SECOND = 100
"""Triangles unwrapped per second, by child processes with shorter limits of their own."""


@contextlib.contextmanager
def confined(function: Callable[..., None], *arguments: object, where: str) -> Iterator[Path]:
    """Runs `function(folder, *arguments)` in a child process and yields the folder, which is deleted after the block.

    Function and arguments are pickled for the child; results are never unpickled. If the block is left early, even by
    a signal, the child and all its descendants are killed.

    Args:
        function: a module's top-level function; it calls `allow_file` and `allow_triangles` for what it reads.
        where: the file, as named in errors.
    """
    with tempfile.TemporaryDirectory(prefix="hyaline-reader-", ignore_cleanup_errors=True) as scratch:
        folder = Path(scratch)
        with naming(folder):
            (folder / "answer").mkdir()
            (folder / "temporary").mkdir()
            (folder / "call").write_bytes(pickle.dumps((function, arguments, where, CPU_S, MEMORY)))
        started, used = time.monotonic(), _cpu_of_children()
        with (folder / "said").open("wb") as said:
            status = _run(folder, said.fileno())
        answer = _answer(folder)
        if status != 0 or answer is None:
            seconds = max(time.monotonic() - started if status == -signal.SIGALRM else _cpu_of_children() - used, 0)
            raise HyalineError(f"{where}: {_met(status, seconds)}")
        for line in (folder / "said").read_text(errors="replace").splitlines():
            say(line)
        if "error" in answer:
            raise HyalineError(str(answer["error"]))
        yield folder / "answer"


def _run(folder: Path, said: int) -> int:
    """Runs the child process and returns its exit status; kills its process group in any case."""
    environment = {
        **child_environment(),
        "TMPDIR": str(folder / "temporary"),
        # Each thread of a pool reserves address space.
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "MALLOC_ARENA_MAX": "2",
    }
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "datagen.machine.confined", str(folder), str(os.getpid())],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=said,
        start_new_session=True,
    )
    try:
        return process.wait()
    finally:
        with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS: the group has ended.
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _answer(folder: Path) -> dict[str, object] | None:
    """How the process ended, as it recorded it; None if it could not."""
    try:
        answer = json.loads((folder / "end.json").read_bytes())
    except (OSError, ValueError):
        return None
    return answer if isinstance(answer, dict) else None


def _met(status: int, seconds: float) -> str:
    smaller = "make it smaller, or split it"
    if status == -signal.SIGXCPU:
        return f"reading it took more than {seconds:.0f} s of CPU time, and was ended; {smaller}"
    if status == -signal.SIGALRM:
        return f"reading it took more than {seconds:.0f} s, and was ended; {smaller}"
    if status == -signal.SIGKILL:
        return f"its reader was killed (the system does that where memory runs out); {smaller}"
    if status < 0:
        name = signal.Signals(-status).name
        return f"its reader crashed ({name}); the file is damaged, or needs too much memory: export it again, smaller"
    return f"its reader ended with status {status} and no answer; export the file again"


def _cpu_of_children() -> float:
    times = os.times()
    return times.children_user + times.children_system


# Inside the process


class _Limits:
    """The limits of this process; they rise with everything it reads."""

    def __init__(self, cpu_s: float, memory: float) -> None:
        self.cpu_s, self.memory = cpu_s, memory
        self.deadline = time.monotonic() + PATIENCE * cpu_s
        self._seen: set[Path] = set()
        self._set()

    def raise_by(self, cpu_s: float, memory: float, *, waiting_s: float = 0.0) -> None:
        self.cpu_s, self.memory = self.cpu_s + cpu_s, self.memory + memory
        self.deadline += PATIENCE * cpu_s + waiting_s
        self._set()

    def is_new(self, path: Path) -> bool:
        """True when a file is seen for the first time; reading it again does not raise the limits."""
        before = len(self._seen)
        self._seen.add(path.resolve())
        return len(self._seen) > before

    def _set(self) -> None:
        _set_soft(resource.RLIMIT_CPU, round(self.cpu_s))
        _set_soft(resource.RLIMIT_AS, round(self.memory))
        # Its signal is not handled: it ends native code as well, which would keep Python from handling it.
        signal.setitimer(signal.ITIMER_REAL, max(self.deadline - time.monotonic(), 0.1))


_limits: _Limits | None = None
"""None outside such a process."""


def allow_file(path: Path, size: int) -> None:
    """Raises this process's limits by the time and memory that reading a file takes."""
    if _limits is not None and _limits.is_new(path):
        _limits.raise_by(CPU_S_PER_BYTE * size, MEMORY_PER_BYTE * size)


def allow_triangles(count: int) -> None:
    """Raises this process's limits by what making a scene of these triangles takes."""
    if _limits is not None:
        waiting_s = 60 + count / UNWRAPPED_A_SECOND
        _limits.raise_by(CPU_S_PER_TRIANGLE * count, MEMORY_PER_TRIANGLE * count, waiting_s=waiting_s)


def _set_soft(what: int, limit: int) -> None:
    _, hard = resource.getrlimit(what)
    limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
    with contextlib.suppress(ValueError, OSError):  # macOS cannot limit address space.
        resource.setrlimit(what, (limit, hard))


def _main(folder: Path, parent: int) -> None:
    global _limits
    function, arguments, where, cpu_s, memory = pickle.loads((folder / "call").read_bytes())
    die_with(parent)
    _limits = _Limits(cpu_s, memory)
    end: dict[str, object] = {}
    try:
        function(folder / "answer", *arguments)
    except HyalineError as error:
        end = {"error": str(error)}
    except MemoryError:
        limit = f"{_limits.memory / 1e9:.1f} GB of memory"
        end = {"error": f"{where}: needs more than {limit} to be read; make it smaller, or split it"}
    # Libraries raise all kinds of exceptions on broken files.
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        end = {"error": f"{where}: cannot be read ({reason[:200]}); the file is damaged, export it again"}
    (folder / "end.json").write_text(json.dumps(end))


if __name__ == "__main__":
    # `allow_file` has to find the limits in the module that others import.
    from datagen.machine import confined as this

    this._main(Path(sys.argv[1]), int(sys.argv[2]))
