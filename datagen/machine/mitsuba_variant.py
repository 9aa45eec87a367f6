"""The choice of Mitsuba's variant on this machine, made before anything imports Mitsuba or Dr.Jit.

CUDA is chosen where a GPU renders a test scene. Else Dr.Jit 1.5 takes the newest libLLVM that it finds. LLVM 15, which
Debian 12 ships, and 16 load and then abort the process at the first render (they cannot lower llvm.minimum on x86-64);
17 to 23 work. So the library is chosen here and passed on in DRJIT_LIBLLVM_PATH.
"""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportCallIssue=false

import contextlib
import functools
import gc
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, cast

from datagen.disk.errors import HyalineError
from datagen.disk.records import commit_sealed, load_sealed
from datagen.disk.storage import private_cache, sha256
from datagen.machine.processes import num_cores
from datagen.terminal.command import hold_signals
from datagen.terminal.plugins import install_command

MIN_LLVM = 17
VARIABLE = "DRJIT_LIBLLVM_PATH"

SYSTEM_PATTERNS = (
    *("/usr/lib/*-linux-gnu/libLLVM*.so*", "/usr/lib/llvm-*/lib/libLLVM*.so*"),
    *("/usr/lib64/libLLVM*.so*", "/usr/lib64/llvm*/lib/libLLVM*.so*"),
    *("/opt/homebrew/opt/llvm*/lib/libLLVM.dylib", "/usr/local/opt/llvm*/lib/libLLVM.dylib"),
)

DRIVERS = (Path("/proc/driver/nvidia/version"), Path("/dev/nvidiactl"), Path("/usr/lib/wsl/lib/libcuda.so.1"))
"""Files of an NVIDIA driver: on Linux, in containers, and under Windows (WSL 2)."""

PROBE_LIMIT_S = 60
"""Time limit of the test render, which compiles kernels."""


class LlvmLibrary(NamedTuple):
    """A libLLVM file and the version that it reports."""

    path: Path
    version: str


def choose_llvm() -> LlvmLibrary | None:
    """The libLLVM to use: from the user's variable, else the wheel's, else the system's newest; None if none works."""
    if named := os.environ.get(VARIABLE):
        return probe(Path(named))
    return probe(Path(sys.prefix) / "lib" / "libLLVM.so") or system_llvm()


def system_llvm() -> LlvmLibrary | None:
    """The system's newest libLLVM that works, or None."""
    paths = {path.resolve() for pattern in SYSTEM_PATTERNS for path in Path("/").glob(pattern.lstrip("/"))}
    # The version is in the name, so libraries that are too old are never loaded.
    named = [(int(match[1]), path) for path in paths if (match := re.search(r"(\d+)", path.name.replace("LLVM", "")))]
    found = (probe(path) for number, path in sorted(named, reverse=True) if number >= MIN_LLVM)
    return next((library for library in found if library is not None), None)


def probe(path: Path) -> LlvmLibrary | None:
    """The library with the version that it reports to a child process; None if it is not a libLLVM that works."""
    command = [sys.executable, "-I", "-S", "-c", _LLVM_PROBE, str(path)]
    if not path.is_file():
        return None
    answer = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    version = answer.stdout.split()
    if answer.returncode != 0 or int(version[0]) < MIN_LLVM:
        return None
    return LlvmLibrary(path=path, version=".".join(version))


def has_gpu() -> bool:
    """True where an NVIDIA driver is loaded."""
    return any(path.exists() for path in DRIVERS)


@functools.cache
def cuda_problem(*, again: bool = False) -> str | None:
    """Why Mitsuba cannot render on the GPU, or None if it can; a child process tries it, which may crash or hang.

    The answer is cached for later processes, until the driver, Mitsuba or the variables that choose a GPU change.

    Args:
        again: ignore the cached answer.
    """
    drivers = [path.read_text() if path == DRIVERS[0] else path.stat().st_size for path in DRIVERS if path.exists()]
    packages = [importlib.metadata.version(name) for name in ("mitsuba", "drjit")]
    variables = ("CUDA_VISIBLE_DEVICES", "DRJIT_LIBCUDA_PATH", "DRJIT_LIBOPTIX_PATH", "LD_LIBRARY_PATH")
    asked = drivers, packages, [os.environ.get(name) for name in variables], _GPU_PROBE
    cache = private_cache("gpu")
    kept = None if cache is None else cache / f"{sha256(repr(asked).encode())[:32]}.json"
    if kept is not None and not again:
        with contextlib.suppress(HyalineError, OSError, KeyError):
            return cast(str | None, load_sealed(kept)["problem"])
    problem = _test_render()
    if kept is not None:
        with contextlib.suppress(OSError):  # In a read-only home, the next process asks again.
            commit_sealed(kept, {"problem": problem})
    return problem


def _test_render() -> str | None:
    command = [sys.executable, "-P", "-c", _GPU_PROBE]
    try:
        answer = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PROBE_LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"the test render took more than {PROBE_LIMIT_S} s"
    lines = answer.stderr.strip().splitlines() or [f"the test render ended with status {answer.returncode}"]
    return lines[-1] if answer.returncode else None


_LLVM_PROBE = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
numbers = [ctypes.c_uint() for _ in range(3)]
library.LLVMGetVersion(*map(ctypes.byref, numbers))
print(*(number.value for number in numbers))
"""

_GPU_PROBE = """
import mitsuba as mi
mi.set_variant("cuda_ad_rgb")
image = mi.render(mi.load_dict(mi.cornell_box()), spp=1)
assert float(image.array[0]) >= 0
"""


class VariantChoice(NamedTuple):
    """The variant that this machine will use, and why."""

    variant: str
    reason: str


@functools.cache
def choose_variant() -> VariantChoice:
    """CUDA where a GPU renders, else LLVM, whose library Dr.Jit then finds by its variable.

    Raises:
        HyalineError: neither a GPU that renders nor a libLLVM that works.
    """
    library = choose_llvm()
    if library is not None:
        os.environ[VARIABLE] = str(library.path)
    if has_gpu() and cuda_problem() is None:
        return VariantChoice("cuda_ad_rgb", "the GPU renders a test scene")
    if library is None:
        raise HyalineError(f"Mitsuba: no libLLVM of version {MIN_LLVM} or newer here; `{llvm_remedy()}`")
    return VariantChoice("llvm_ad_rgb", f"LLVM {library.version} from {library.path}")


def llvm_remedy() -> str:
    """The command that gives this machine a libLLVM: one that installs it, unless the user's variable hides it."""
    if os.environ.get(VARIABLE):
        return f"unset {VARIABLE}"
    remedies = {("Darwin", "arm64"): "brew install llvm", ("Linux", "x86_64"): install_command("llvm")}
    return remedies.get((platform.system(), platform.machine()), "apt install libllvm19")


_num_threads = 2
"""Dr.Jit's threads while it works, including the calling thread; set by `use_mitsuba`."""


def use_mitsuba(*, threads: int | None = None) -> str:
    """Sets up Mitsuba in this process and returns its variant.

    Args:
        threads: number of rendering threads; one per core by default.

    Raises:
        HyalineError: neither a GPU that renders nor a libLLVM that works.
    """
    global _num_threads
    variant = choose_variant().variant
    _num_threads = max(2, threads or num_cores())
    _set_variant(variant)
    return variant


def use_parser() -> None:
    """Sets up Mitsuba for reading scene files, which needs neither a GPU nor a libLLVM; a variant in use stays."""
    import mitsuba as mi

    _set_variant(mi.variant() or "scalar_rgb")


def _set_variant(variant: str) -> None:
    # A signal that raises while Mitsuba's modules import each other leaves them half imported (3.9).
    with hold_signals():
        import mitsuba as mi

        start_workers()
        mi.set_variant(variant)
    # Mitsuba looks for plugins in the working directory first: a folder `plugins/` there would run foreign code.
    resolver = mi.file_resolver()
    resolver.clear()
    resolver.append(str(Path(mi.__file__).parent))
    mi.set_log_level(mi.LogLevel.Error)


def start_workers() -> None:
    """Starts Dr.Jit's worker threads again after `short_lived_workers` has ended them.

    With one thread, Dr.Jit 1.5 has no workers, and Mitsuba 3.9 waits forever for one to read or write an EXR.
    """
    import drjit as dr

    dr.set_thread_count(_num_threads)


_one_at_a_time = threading.Lock()


@contextlib.contextmanager
def short_lived_workers(*, none: bool = False) -> Iterator[None]:
    """Ends Dr.Jit's worker threads after this block, until the next one begins. Call `use_mitsuba` first.

    Idle workers spin for some 20 ms after each kernel (Dr.Jit 1.5), on cores that torch's threads wait for: training on
    light paths took a fifth longer on two cores. Starting and ending a worker takes 0.1 ms. Threads that enter the
    block take turns, because all kernels use the same workers.

    Args:
        none: kernels in the block run on the calling thread alone.
    """
    import drjit as dr

    with _one_at_a_time:
        if not none:
            start_workers()
        try:
            yield
        finally:
            dr.set_thread_count(1)


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Keeps Python's garbage collector away while a kernel may be recorded.

    Dr.Jit 1.5 aborted the process once, when the collector freed arrays of another scene during a recording.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
