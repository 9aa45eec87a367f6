"""What this machine has, what hyaline will use, and one command for each missing part."""

import functools
import importlib.metadata
import os
import platform
import subprocess
from typing import NamedTuple

from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import (
    MIN_LLVM,
    VARIABLE,
    choose_llvm,
    choose_variant,
    cuda_problem,
    has_gpu,
    llvm_remedy,
)
from datagen.machine.processes import ROOT
from datagen.terminal.plugins import VERSION, install_command

LIST_LIMIT_S = 5
"""Time limit of `nvidia-smi`, which hangs when its driver does."""


class Finding(NamedTuple):
    """The result of one check."""

    what: str
    found: str
    remedy: str | None = None
    """The command that fixes it; None when all is well."""


def examine() -> list[Finding]:
    """Checks the installation, cores, processor, GPU, and what path tracing, training and proxies need."""
    mitsuba = _package("Mitsuba", "generate", "building datasets and tracing layers need it")
    return [
        Finding("hyaline", f"{VERSION} in {ROOT}"),
        Finding("machine", f"{os.cpu_count()} cores, {platform.machine()}, {platform.system()}"),
        Finding("GPU", _gpu(tries=mitsuba.remedy is None)),
        *([mitsuba] if mitsuba.remedy else _mitsuba(mitsuba.found)),
        _package("torch", "model", "training, and rendering with trained runs, need it"),
        _package("PyMeshLab", "proxies", "proxies of the kind wrap need it"),
    ]


def _package(what: str, extra: str, need: str) -> Finding:
    """The version of an installed package, or what brings it."""
    try:
        return Finding(what, importlib.metadata.version(what.lower()))
    except importlib.metadata.PackageNotFoundError:
        return Finding(what, f"not installed; {need}", install_command(extra))


def _gpu(*, tries: bool) -> str:
    """Name and driver of each GPU, as `nvidia-smi` lists them, and why Mitsuba cannot use them where it cannot."""
    command = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=LIST_LIMIT_S, check=False)
        found = (answer.stdout.strip().replace("\n", "; ") if answer.returncode == 0 else "") or "none"
    except (OSError, subprocess.TimeoutExpired) as error:
        found = f"an NVIDIA driver, but nvidia-smi gave no answer ({error})" if has_gpu() else "none"
    if tries and has_gpu() and (problem := cuda_problem(again=True)) is not None:
        return f"{found}; Mitsuba cannot render on it: {problem}"
    return found


def _mitsuba(version: str) -> list[Finding]:
    """Mitsuba, and the libLLVM that it needs without a GPU."""
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
