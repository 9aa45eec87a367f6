"""Building by the command, and what it leaves."""

import sys
from pathlib import Path

FLAGS = (
    *("--preset", "tiny", "--resolution", "16", "--num-layers", "4"),
    *("--views", "4", "--test-views", "2", "--spp", "8", "--test-spp", "8"),
)


def tree(root: Path) -> dict[str, bytes]:
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def command(folder: Path, out: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "datagen", "build", "--scene", str(folder), "--out", str(out), *FLAGS, *more]
