"""Finds a libLLVM that works, before Dr.Jit is imported. Standard library only.

Dr.Jit 1.5 takes the newest libLLVM that it finds. LLVM 15, which Debian 12 ships, and 16 load and then abort the
process at the first render (they cannot lower llvm.minimum on x86-64); 17 to 23 work. So the choice is made here and
passed on in DRJIT_LIBLLVM_PATH.
"""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

MIN_LLVM = 17
VARIABLE = "DRJIT_LIBLLVM_PATH"

SYSTEM_PATTERNS = (
    *("/usr/lib/*-linux-gnu/libLLVM*.so*", "/usr/lib/llvm-*/lib/libLLVM*.so*"),
    *("/usr/lib64/libLLVM*.so*", "/usr/lib64/llvm*/lib/libLLVM*.so*"),
    *("/opt/homebrew/opt/llvm*/lib/libLLVM.dylib", "/usr/local/opt/llvm*/lib/libLLVM.dylib"),
)


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
    command = [sys.executable, "-I", "-S", "-c", _PROBE, str(path)]
    if not path.is_file():
        return None
    answer = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    version = answer.stdout.split()
    if answer.returncode != 0 or int(version[0]) < MIN_LLVM:
        return None
    return LlvmLibrary(path=path, version=".".join(version))


_PROBE = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
numbers = [ctypes.c_uint() for _ in range(3)]
library.LLVMGetVersion(*map(ctypes.byref, numbers))
print(*(number.value for number in numbers))
"""


if __name__ == "__main__":
    # For `make setup`: prints the system's library, or nothing.
    system = system_llvm()
    print(system.path if system else "")
