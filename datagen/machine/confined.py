"""Runs a function in a child process with limits on memory and CPU time, to read untrusted files.

Whatever a file does to its reader (a loop, a crash, 60 GB, an unexpected exception) ends only that process and becomes
one HyalineError here. The function returns its result as files in a scratch folder.
"""

import contextlib
import os
import pickle
import resource
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from datagen.disk.errors import HyalineError, naming
from datagen.machine.processes import die_with, run_child
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
            ["-m", "datagen.machine.confined", str(folder), str(os.getpid())],
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
    from datagen.machine import confined as this

    this._main(Path(sys.argv[1]), int(sys.argv[2]))
