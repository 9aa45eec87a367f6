"""Building by the command, and what it leaves."""

import shlex
import sys
from pathlib import Path

FLAGS = "--preset tiny --resolution 16 --num-layers 4 --views 4 --test-views 2 --spp 8 --test-spp 8"


def tree(root: Path) -> dict[str, bytes]:
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def build(folder: Path, out: Path, more: str = "") -> str:
    """The command line that builds a folder's scene."""
    return f"datagen build --scene {shlex.quote(str(folder))} --out {shlex.quote(str(out))} {FLAGS} {more}"


def command(line: str) -> list[str]:
    """What runs a command line in a process of its own."""
    return [sys.executable, "-m", *shlex.split(line)]
