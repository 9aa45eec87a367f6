"""This machine's GPU, and whether Mitsuba renders on it."""

import contextlib
import functools
import importlib.metadata
import os
import subprocess
import sys
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.records import commit_sealed, load_sealed
from datagen.disk.storage import private_cache, sha256

DRIVERS = (Path("/proc/driver/nvidia/version"), Path("/dev/nvidiactl"), Path("/usr/lib/wsl/lib/libcuda.so.1"))
"""Files of an NVIDIA driver: on Linux, in containers, and under Windows (WSL 2)."""

LIST_LIMIT_S, PROBE_LIMIT_S = 5, 60
"""Timeouts of `nvidia-smi`, which hangs when its driver does, and of the test render, which compiles kernels."""


def has_gpu() -> bool:
    """True where an NVIDIA driver is loaded."""
    return any(path.exists() for path in DRIVERS)


def describe_gpus() -> str:
    """Name and driver of each GPU, as `nvidia-smi` lists them, or why it cannot; `none` without a GPU."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        status, out, _ = _ask(query, LIST_LIMIT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"an NVIDIA driver, but nvidia-smi gave no answer ({error})" if has_gpu() else "none"
    return (out.strip().replace("\n", "; ") if status == 0 else "") or "none"


@functools.cache
def cuda_problem(*, again: bool = False) -> str | None:
    """Why Mitsuba cannot render on the GPU, or None if it can; a child process tries it, which may crash or hang.

    The answer is cached for later processes, until the driver, Mitsuba or the variables that choose a GPU change.

    Args:
        again: ignore the cached answer.
    """
    cache = private_cache("gpu")
    if cache is None:
        return _render_test_scene()
    kept = cache / f"{sha256(repr(_asked_about()).encode())[:32]}.json"
    if not again:
        with contextlib.suppress(HyalineError, OSError, KeyError):
            problem = load_sealed(kept)["problem"]
            return problem if isinstance(problem, str) else None
    problem = _render_test_scene()
    with contextlib.suppress(OSError):  # In a read-only home, the next process asks again.
        commit_sealed(kept, {"problem": problem})
    return problem


def _asked_about() -> tuple[object, ...]:
    """Everything that the answer depends on."""
    drivers = [path.read_text() if path == DRIVERS[0] else path.stat().st_size for path in DRIVERS if path.exists()]
    packages = [importlib.metadata.version(name) for name in ("mitsuba", "drjit")]
    variables = ("CUDA_VISIBLE_DEVICES", "DRJIT_LIBCUDA_PATH", "DRJIT_LIBOPTIX_PATH", "LD_LIBRARY_PATH")
    return drivers, packages, [os.environ.get(name) for name in variables], _PROBE


def _render_test_scene() -> str | None:
    try:
        status, _, errors = _ask([sys.executable, "-P", "-c", _PROBE], PROBE_LIMIT_S)
    except subprocess.TimeoutExpired:
        return f"the test render took more than {PROBE_LIMIT_S} s"
    return None if status == 0 else (errors.strip().splitlines() or [f"the test render ended with status {status}"])[-1]


def _ask(command: list[str], limit_s: float) -> tuple[int, str, str]:
    """Status, output and errors of a program; one that is too slow is killed."""
    answer = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=limit_s, check=False
    )
    return answer.returncode, answer.stdout, answer.stderr


_PROBE = """
import mitsuba as mi
mi.set_variant("cuda_ad_rgb")
image = mi.render(mi.load_dict(mi.cornell_box()), spp=1)
assert float(image.array[0]) >= 0
"""
