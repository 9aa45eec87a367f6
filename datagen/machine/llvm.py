"""Finds a libLLVM that works, before Dr.Jit is imported. Standard library only.

Dr.Jit 1.5 takes the newest libLLVM that it finds. LLVM 15, which Debian 12 ships, and 16 load and then abort the
process at the first render (they cannot lower llvm.minimum on x86-64); 17 to 23 work. So the choice is made here and
passed on in DRJIT_LIBLLVM_PATH.
"""

import os
import platform
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from datagen.terminal.distribution import install_command

MIN_LLVM = 17
VARIABLE = "DRJIT_LIBLLVM_PATH"

SYSTEM_PATTERNS = (
    ("/usr/lib/x86_64-linux-gnu", "libLLVM*.so*"),
    ("/usr/lib/aarch64-linux-gnu", "libLLVM*.so*"),
    ("/usr/lib", "llvm-*/lib/libLLVM*.so*"),
    ("/usr/lib64", "libLLVM*.so*"),
    ("/usr/lib64", "llvm*/lib/libLLVM*.so*"),
    ("/opt/homebrew/opt", "llvm*/lib/libLLVM.dylib"),
    ("/usr/local/opt", "llvm*/lib/libLLVM.dylib"),
)


@dataclass(frozen=True, kw_only=True)
class LlvmLibrary:
    """A libLLVM file and the version that it reports."""

    path: Path
    version: tuple[int, int, int]
    source: str
    """`environment`, `wheel` or `system`."""

    @property
    def works(self) -> bool:
        return self.version[0] >= MIN_LLVM


def choose_llvm() -> LlvmLibrary | None:
    """The libLLVM to use: from the user's variable, else the wheel's, else the system's newest; None if none works."""
    if named := os.environ.get(VARIABLE):
        found = probe(Path(named), source="environment")
        return found if found and found.works else None
    wheel = probe(Path(sys.prefix) / "lib" / "libLLVM.so", source="wheel")
    if wheel and wheel.works:
        return wheel
    return system_llvm()


def system_llvm() -> LlvmLibrary | None:
    """The system's newest libLLVM that works, or None."""
    paths = {path.resolve() for folder, pattern in SYSTEM_PATTERNS for path in Path(folder).glob(pattern)}
    # The version is in the name, so libraries that are too old are never loaded.
    named = [(int(match[1]), path) for path in paths if (match := re.search(r"(\d+)", path.name.replace("LLVM", "")))]
    for number, path in sorted(named, reverse=True):
        if number >= MIN_LLVM and (found := probe(path, source="system")) and found.works:
            return found
    return None


def probe(path: Path, *, source: str) -> LlvmLibrary | None:
    """The library with the version that it reports to a child process; None if it is not a libLLVM."""
    if not path.is_file():
        return None
    answer = subprocess.run(
        [sys.executable, "-I", "-S", "-c", _PROBE, str(path)], capture_output=True, text=True, timeout=60, check=False
    )
    numbers = answer.stdout.split()
    if answer.returncode != 0 or len(numbers) != 3:
        return None
    return LlvmLibrary(path=path, version=(int(numbers[0]), int(numbers[1]), int(numbers[2])), source=source)


_PROBE = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
numbers = [ctypes.c_uint() for _ in range(3)]
library.LLVMGetVersion(*map(ctypes.byref, numbers))
print(*(number.value for number in numbers))
"""


def advice() -> str:
    """The command that gives this machine a libLLVM: one that installs it, unless the user's variable hides it."""
    if os.environ.get(VARIABLE):
        return f"unset {VARIABLE}"
    if platform.system() == "Darwin":
        return "brew install llvm"
    if platform.system() == "Linux" and platform.machine() == "x86_64":
        return install_command("llvm")
    return f"install a libLLVM of version {MIN_LLVM} or newer (Debian 12: apt install libllvm19)"


if __name__ == "__main__":
    # For `make setup`: prints the system's library, or nothing.
    system = system_llvm()
    print(system.path if system else "")
