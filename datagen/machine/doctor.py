"""What this machine has, what will be used of it, and the one command that fixes whatever is missing."""

import importlib.metadata
import os
import platform
import shutil
import subprocess
from dataclasses import dataclass

from datagen.machine.llvm import advice
from datagen.machine.mitsuba_variant import choose_variant
from datagen.machine.processor import describe_processor


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that was looked at."""

    what: str
    found: str
    remedy: str | None
    """The command that mends it; None when all is well."""


def examine() -> list[Finding]:
    """Looks at cores, processor, GPU, libLLVM, the Mitsuba variant, torch and the libraries that PyMeshLab needs."""
    choice = choose_variant()
    llvm = choice.llvm
    return [
        Finding(what="cores", found=f"{os.cpu_count()} ({platform.system()})", remedy=None),
        Finding(what="processor", found=describe_processor(), remedy=None),
        Finding(what="GPU", found=_gpu(), remedy=None),
        Finding(
            what="libLLVM",
            found=f"{'.'.join(map(str, llvm.version))} ({llvm.source}: {llvm.path})" if llvm else "none of 17 or newer",
            remedy=None if llvm else advice(),
        ),
        Finding(what="Mitsuba", found=f"{_version('mitsuba')}, variant {choice.variant}: {choice.reason}", remedy=None),
        Finding(what="torch", found=_version("torch"), remedy=None),
        _meshlab(),
    ]


def _gpu() -> str:
    if shutil.which("nvidia-smi") is None:
        return "none"
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    answer = subprocess.run(query, capture_output=True, text=True, timeout=30, check=False)
    return answer.stdout.strip().replace("\n", "; ") or "none"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _meshlab() -> Finding:
    """PyMeshLab needs the system's libGL; boxes and ellipsoids are made without it."""
    version = _version("pymeshlab")
    if version == "not installed":
        return Finding(what="PyMeshLab", found=version, remedy='pip install -e "."')
    try:
        import ctypes

        ctypes.CDLL("libGL.so.1" if platform.system() == "Linux" else None)
    except OSError:
        return Finding(
            what="PyMeshLab",
            found=f"{version}, cannot load: libGL.so.1 is missing (boxes and ellipsoids are made without it)",
            remedy="apt install libgl1",
        )
    return Finding(what="PyMeshLab", found=version, remedy=None)
