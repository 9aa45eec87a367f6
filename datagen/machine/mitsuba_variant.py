"""The choice of Mitsuba's variant on this machine, made before anything imports Mitsuba or Dr.Jit."""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportCallIssue=false

import contextlib
import functools
import gc
import os
import platform
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from datagen.disk.errors import HyalineError
from datagen.machine.hardware import cuda_problem, has_gpu
from datagen.machine.llvm import MIN_LLVM, VARIABLE, choose_llvm
from datagen.terminal.command import hold_signals
from datagen.terminal.plugins import install_command


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


def num_cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
