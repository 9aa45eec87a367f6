"""What this machine has, what hyaline will use, and one command for each missing part."""

import functools
import importlib.metadata
import os
import platform
import subprocess
from dataclasses import asdict, dataclass

from datagen.disk.errors import HyalineError
from datagen.machine.hardware import cuda_problem, describe_gpus, has_gpu, torch_cuda_problem
from datagen.machine.llvm import VARIABLE, advice, choose_llvm
from datagen.machine.mitsuba_variant import choose_variant
from datagen.machine.processes import ROOT
from datagen.terminal.command import tell_json
from datagen.terminal.distribution import VERSION, install_command


@dataclass(frozen=True, kw_only=True)
class Finding:
    """The result of one check."""

    what: str
    found: str
    remedy: str | None
    """The command that fixes it; None when all is well."""


def examine() -> list[Finding]:
    """Checks the installation, cores, processor, GPU, and what path tracing, training and proxies need."""
    return [
        Finding(what="hyaline", found=f"{VERSION} in {ROOT}", remedy=None),
        Finding(what="cores", found=f"{os.cpu_count()} ({platform.system()})", remedy=None),
        Finding(what="processor", found=platform.machine(), remedy=None),
        Finding(what="GPU", found=_gpu(), remedy=None),
        *_mitsuba(),
        _torch(),
        _meshlab(),
    ]


def tell_findings(findings: list[Finding], *, as_json: bool) -> None:
    """Prints them as lines or as one JSON object."""
    if as_json:
        tell_json({"findings": [asdict(finding) for finding in findings]})
        return
    for finding in findings:
        print(f"{finding.what:10} {finding.found}")
        if finding.remedy:
            print(f"{'':10} fix it with: {finding.remedy}")


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
    found = f"{'.'.join(map(str, llvm.version))} ({llvm.source}: {llvm.path})" if llvm else "none of 17 or newer"
    if llvm is None and named:
        found = f"{VARIABLE}={named} is no libLLVM of 17 or newer"
    try:
        choice = choose_variant()
        runs = f"variant {choice.variant}: {choice.reason}"
    except HyalineError:
        runs = "cannot render without a libLLVM"
    return [
        Finding(what="libLLVM", found=found, remedy=None if llvm else advice()),
        Finding(what="Mitsuba", found=f"{version}, {runs}", remedy=None),
    ]


def _torch() -> Finding:
    version = _version("torch")
    if version is None:
        return _missing("torch", "model", "training, and rendering with trained runs, need it")
    if has_gpu():
        problem = torch_cuda_problem()
        version += ", computes on the GPU" if problem is None else f", does not compute on the GPU: {problem}"
    return Finding(what="torch", found=version, remedy=None)


def _version(package: str) -> str | None:
    """The version of an installed package, else None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _missing(what: str, extra: str, need: str) -> Finding:
    return Finding(what=what, found=f"not installed; {need}", remedy=install_command(extra))


def _meshlab() -> Finding:
    """PyMeshLab needs the system's libGL; all proxies but wraps are made without it."""
    version = _version("pymeshlab")
    if version is None:
        return _missing("PyMeshLab", "proxies", "proxies of the kind wrap need it")
    try:
        import ctypes

        ctypes.CDLL("libGL.so.1" if platform.system() == "Linux" else None)
    except OSError:
        return Finding(
            what="PyMeshLab",
            found=f"{version}, cannot load: libGL.so.1 is missing (all proxies but wraps are made without it)",
            remedy="apt install libgl1",
        )
    return Finding(what="PyMeshLab", found=version, remedy=None)


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
