"""What this machine has, what hyaline will use, and one command for each missing part."""

import functools
import importlib.metadata
import os
import platform
import subprocess
from typing import NamedTuple

from datagen.disk.errors import HyalineError
from datagen.machine.hardware import cuda_problem, describe_gpus, has_gpu
from datagen.machine.llvm import MIN_LLVM, VARIABLE, choose_llvm
from datagen.machine.mitsuba_variant import choose_variant, llvm_remedy
from datagen.machine.processes import ROOT
from datagen.terminal.plugins import VERSION, install_command


class Finding(NamedTuple):
    """The result of one check."""

    what: str
    found: str
    remedy: str | None = None
    """The command that fixes it; None when all is well."""


def examine() -> list[Finding]:
    """Checks the installation, cores, processor, GPU, and what path tracing, training and proxies need."""
    return [
        Finding("hyaline", f"{VERSION} in {ROOT}"),
        Finding("machine", f"{os.cpu_count()} cores, {platform.machine()}, {platform.system()}"),
        Finding("GPU", _gpu()),
        *_mitsuba(),
        _torch(),
        _meshlab(),
    ]


def _gpu() -> str:
    """The GPUs, and why Mitsuba cannot use them where it cannot."""
    found = describe_gpus()
    if has_gpu() and _version("mitsuba") is not None and (problem := cuda_problem(again=True)) is not None:
        return f"{found}; Mitsuba cannot render on it: {problem}"
    return found


def _mitsuba() -> list[Finding]:
    """Mitsuba, and the libLLVM that it needs without a GPU."""
    version = _version("mitsuba")
    if version is None:
        return [_missing("Mitsuba", "generate", "building datasets and tracing layers need it")]
    llvm, named = choose_llvm(), os.environ.get(VARIABLE)
    missing = f"{VARIABLE}={named} is no libLLVM of {MIN_LLVM} or newer" if named else f"none of {MIN_LLVM} or newer"
    try:
        choice = choose_variant()
        runs = f"variant {choice.variant}: {choice.reason}"
    except HyalineError:
        runs = "cannot render without a libLLVM"
    return [
        Finding("libLLVM", f"{llvm.version} ({llvm.path})" if llvm else missing, None if llvm else llvm_remedy()),
        Finding("Mitsuba", f"{version}, {runs}"),
    ]


def _torch() -> Finding:
    version = _version("torch")
    if version is None:
        return _missing("torch", "model", "training, and rendering with trained runs, need it")
    return Finding("torch", version)


def _version(package: str) -> str | None:
    """The version of an installed package, else None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _missing(what: str, extra: str, need: str) -> Finding:
    return Finding(what, f"not installed; {need}", install_command(extra))


def _meshlab() -> Finding:
    """PyMeshLab needs the system's libGL; all proxies but wraps are made without it."""
    version = _version("pymeshlab")
    if version is None:
        return _missing("PyMeshLab", "proxies", "proxies of the kind wrap need it")
    try:
        import ctypes

        ctypes.CDLL("libGL.so.1" if platform.system() == "Linux" else None)
    except OSError:
        found = f"{version}, cannot load: libGL.so.1 is missing (all proxies but wraps are made without it)"
        return Finding("PyMeshLab", found, "apt install libgl1")
    return Finding("PyMeshLab", version)


@functools.cache
def code_version() -> str:
    """The version, in a checkout with its commit, such as `0.1.0 (5a596f5)`; `-dirty` marks uncommitted changes."""
    if not (ROOT / ".git").exists():
        return VERSION
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    except (OSError, subprocess.SubprocessError):
        return VERSION
    return f"{VERSION} ({answer.stdout.strip()})"
