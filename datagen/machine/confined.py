"""A function of ours in a process of its own, with limits on memory and time: for files that anybody may have written.

What such a file does to its reader - a hang, a crash, 60 GB, an exception that nobody thought of - ends that process,
and is one error here. What the function found comes back as files in a scratch folder.
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
from datagen.machine.child_python import child_environment
from datagen.machine.workers import die_with
from datagen.terminal.command import say

CPU_S = 8
"""CPU seconds that a process has before it has read anything; a start takes half a second."""
MEMORY = 2_000_000_000
"""Bytes of address space that it has, of which imports and libraries take a quarter."""
CPU_S_PER_BYTE = 3e-5
"""Text of a mesh takes 5e-7, compressed XML 1e-5."""
MEMORY_PER_BYTE = 24
CPU_S_PER_TRIANGLE = 5e-4
"""To mend, to map and to check one takes 1e-4."""
MEMORY_PER_TRIANGLE = 1500
PATIENCE = 10
"""Seconds on the clock for each of the processor: others use it, too."""
UNWRAPPED_A_SECOND = 100
"""Triangles, in child processes whose own limits are shorter."""


@contextlib.contextmanager
def confined(function: Callable[..., None], *arguments: object, where: str) -> Iterator[Path]:
    """The folder that `function(folder, *arguments)` has filled in a process of its own; it is gone after the block.

    Both pass as a pickle, and nothing comes back as one. When the block is left early, by a signal too, the process
    ends with all that it started.

    Args:
        function: of a module, found by its name; it calls `allow` for what it has read.
        where: the file, as errors name it.

    Raises:
        HyalineError: that of the function, or which limit it met, or how it died.
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
    """The status of the process, which is ended with all that it started when this is left."""
    environment = {
        **child_environment(),
        "TMPDIR": str(folder / "temporary"),
        # Each thread of a pool reserves address space.
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "MALLOC_ARENA_MAX": "2",
        # A scene of Mitsuba's is parsed, not rendered.
        "HYALINE_VARIANT": "scalar_rgb",
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
        with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS: of a group that has ended.
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _answer(folder: Path) -> dict[str, object] | None:
    """What the process says of its end; None where it could not say it."""
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


# Inside of the process


class _Limits:
    """What this process may use; everything that it reads allows it more."""

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
        """True when a file is seen for the first time: one that is read again allows nothing more."""
        before = len(self._seen)
        self._seen.add(path.resolve())
        return len(self._seen) > before

    def _set(self) -> None:
        _set_soft(resource.RLIMIT_CPU, round(self.cpu_s))
        _set_soft(resource.RLIMIT_AS, round(self.memory))
        # Its signal is not handled: it ends native code as well, which would keep Python from handling it.
        signal.setitimer(signal.ITIMER_REAL, max(self.deadline - time.monotonic(), 0.1))


_limits: _Limits | None = None
"""None outside of such a process."""


def allow_file(path: Path, size: int) -> None:
    """Says that this process has opened a file, and may use as much more time and memory as reading that takes."""
    if _limits is not None and _limits.is_new(path):
        _limits.raise_by(CPU_S_PER_BYTE * size, MEMORY_PER_BYTE * size)


def allow_triangles(count: int) -> None:
    """Says how many triangles this process has read, and what it takes to make a scene of them."""
    if _limits is not None:
        waiting_s = 60 + count / UNWRAPPED_A_SECOND
        _limits.raise_by(CPU_S_PER_TRIANGLE * count, MEMORY_PER_TRIANGLE * count, waiting_s=waiting_s)


def _set_soft(what: int, limit: int) -> None:
    _, hard = resource.getrlimit(what)
    limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
    with contextlib.suppress(ValueError, OSError):  # macOS takes no limit on address space.
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
    # Nobody can list what broken files raise in the libraries that read them.
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        end = {"error": f"{where}: cannot be read ({reason[:200]}); the file is damaged, export it again"}
    (folder / "end.json").write_text(json.dumps(end))


if __name__ == "__main__":
    # `allow_file` has to find the limits in the module that others import.
    from datagen.machine import confined as this

    this._main(Path(sys.argv[1]), int(sys.argv[2]))
