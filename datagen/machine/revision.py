"""Which code runs: the version, and in a checkout its commit."""

import functools
import subprocess
from pathlib import Path

from datagen.terminal.distribution import VERSION

ROOT = Path(__file__).resolve().parents[2]


@functools.cache
def code_version() -> str:
    """Such as `0.1.0 (5a596f5)`; with `-dirty` where the checkout differs from its commit."""
    if not (ROOT / ".git").exists():
        return VERSION
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    except (OSError, subprocess.SubprocessError):
        return VERSION
    return f"{VERSION} ({answer.stdout.strip()})"
