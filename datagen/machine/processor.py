"""What this processor multiplies fast: bf16, where it has instructions for it."""

import platform
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
BF16_FLAGS = ("amx_bf16", "avx512_bf16", "bf16")
"""Of x86-64 and (the last) of Arm, as Linux names them, the fastest first."""


def bf16_instructions() -> str | None:
    """The processor's instructions for bf16; None where it has none, or nobody can tell (Linux alone does).

    Without them PyTorch multiplies bf16 several times more slowly than fp32.
    """
    if not CPUINFO.is_file():
        return None
    flags: set[str] = set()
    for line in CPUINFO.read_text().splitlines():
        name, _, value = line.partition(":")
        if name.strip() in ("flags", "Features"):
            flags |= set(value.split())
    return next((flag for flag in BF16_FLAGS if flag in flags), None)


def describe_processor() -> str:
    """Its kind, and whether bf16 pays on it."""
    found = bf16_instructions()
    return f"{platform.machine()}, {f'bf16 by {found}' if found else 'no instructions for bf16: use fp32'}"
