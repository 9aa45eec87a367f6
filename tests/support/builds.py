"""Building by the command, and what it leaves."""

import shlex
import sys
from pathlib import Path

from support.commands import Answer, call

FLAGS = (
    *("--preset", "tiny", "--resolution", "16", "--num-layers", "4"),
    *("--views", "4", "--test-views", "2", "--spp", "8", "--test-spp", "8"),
)


def tree(root: Path) -> dict[str, bytes]:
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def command(folder: Path, out: Path, *more: str) -> list[str]:
    """What starts a build in a process of its own."""
    return [sys.executable, "-m", *_words(folder, out, *more)]


def build(folder: Path, out: Path, *more: str) -> Answer:
    """Builds in this process, which spares the second that a new one takes to start."""
    return call(shlex.join(_words(folder, out, *more)))


def build_whole(folder: Path, out: Path, *more: str) -> None:
    """Builds in this process, which must succeed."""
    answer = build(folder, out, *more)
    assert answer.status == 0, answer.err


def _words(folder: Path, out: Path, *more: str) -> list[str]:
    return ["datagen", "build", "--scene", str(folder), "--out", str(out), *FLAGS, *more]
