"""This machine's GPU, and whether Mitsuba renders on it."""

import contextlib
import functools
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.storage import commit_sealed, load_sealed, sha256, user_cache

DRIVERS = (Path("/proc/driver/nvidia/version"), Path("/dev/nvidiactl"), Path("/usr/lib/wsl/lib/libcuda.so.1"))
"""Files of an NVIDIA driver: on Linux, in containers, and under Windows (WSL 2)."""

WSL_PROGRAMS = "/usr/lib/wsl/lib"
"""Where Windows puts `nvidia-smi` under WSL 2, which not every PATH there has."""

LIST_LIMIT_S, PROBE_LIMIT_S = 5, 60
"""Timeouts of `nvidia-smi`, which hangs when its driver does, and of the test render, which compiles kernels."""


def has_gpu() -> bool:
    """True where an NVIDIA driver is loaded."""
    return any(path.exists() for path in DRIVERS)


def describe_gpus() -> str:
    """Name and driver of each GPU, as `nvidia-smi` lists them, or why it cannot; `none` without a GPU."""
    program = shutil.which("nvidia-smi") or shutil.which("nvidia-smi", path=WSL_PROGRAMS) or "nvidia-smi"
    query = [program, "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        status, out, _ = _ask(query, LIST_LIMIT_S)
    except FileNotFoundError:
        return "an NVIDIA driver, but no nvidia-smi" if has_gpu() else "none"
    except subprocess.TimeoutExpired:
        return f"nvidia-smi gave no answer within {LIST_LIMIT_S} s"
    except OSError as error:
        return f"nvidia-smi cannot be run ({error.strerror})"
    return (out.strip().replace("\n", "; ") if status == 0 else "") or "none"


@functools.cache
def cuda_problem(*, again: bool = False) -> str | None:
    """Why Mitsuba cannot render on the GPU, or None if it can; a child process tries it, which may crash or hang.

    The answer is cached for later processes, until the driver, Mitsuba or the variables that choose a GPU change.

    Args:
        again: ignore the cached answer.
    """
    name = f"{sha256(repr(_asked_about()).encode())[:32]}.json"
    if not again:
        try:
            problem = load_sealed(user_cache("gpu") / name)["problem"]
        except (HyalineError, OSError, KeyError):
            pass
        else:
            return problem if isinstance(problem, str) else None
    problem = _render_test_scene()
    # In a read-only home, or without one, the next process asks again.
    with contextlib.suppress(HyalineError, OSError):
        commit_sealed(user_cache("gpu") / name, {"problem": problem})
    return problem


def torch_cuda_problem() -> str | None:
    """Why torch does not compute on the GPU, or None if it does; a child process asks it."""
    code = "import torch; print(torch.version.cuda, torch.cuda.is_available())"
    try:
        status, out, _ = _ask([sys.executable, "-P", "-c", code], PROBE_LIMIT_S)
    except subprocess.TimeoutExpired:
        return f"importing it took more than {PROBE_LIMIT_S} s"
    if status != 0:
        return "it cannot be imported"
    version, is_available = out.split()
    if is_available == "True":
        return None
    return "it is a build for CPUs" if version == "None" else f"its CUDA {version} finds no GPU that it can use"


def _asked_about() -> tuple[object, ...]:
    """Everything that the answer depends on."""
    import importlib.metadata

    driver = [_version_of(path) for path in DRIVERS if path.exists()]
    packages = [importlib.metadata.version(name) for name in ("mitsuba", "drjit")]
    variables = ("CUDA_VISIBLE_DEVICES", "DRJIT_LIBCUDA_PATH", "DRJIT_LIBOPTIX_PATH", "LD_LIBRARY_PATH")
    return driver, packages, [os.environ.get(name) for name in variables], _PROBE


def _version_of(driver: Path) -> object:
    """Changes with the driver: what a file under /proc says, or the size and time of a library."""
    if driver.is_relative_to("/proc"):
        return driver.read_text()
    found = driver.stat()
    return str(driver), found.st_size, int(found.st_mtime) if driver.is_file() else 0


def _render_test_scene() -> str | None:
    try:
        status, _, errors = _ask([sys.executable, "-P", "-c", _PROBE], PROBE_LIMIT_S)
    except subprocess.TimeoutExpired:
        return f"the test render took more than {PROBE_LIMIT_S} s"
    if status == 0:
        return None
    lines = errors.strip().splitlines()
    return lines[-1] if lines else f"the test render ended with status {status}"


def _ask(command: list[str], limit_s: float) -> tuple[int, str, str]:
    """Status, output and errors of a program.

    A program that is too slow is killed, but not waited for long: while the driver hangs, it cannot exit.
    """
    with tempfile.TemporaryFile("w+", errors="replace") as out, tempfile.TemporaryFile("w+", errors="replace") as err:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=err)
        try:
            status = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(1)
            raise
        out.seek(0)
        err.seek(0)
        return status, out.read(), err.read()


_PROBE = """
import mitsuba as mi
mi.set_variant("cuda_ad_rgb")
image = mi.render(mi.load_dict(mi.cornell_box()), spp=1)
assert float(image.array[0]) >= 0
"""
