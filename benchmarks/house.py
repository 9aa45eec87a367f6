"""The size of the house: files, lines and imports of the installed packages, and what a build imports."""

import ast
import subprocess
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("datagen", "proxies", "model", "eval", "hyaline")

BUILD = """
import atexit, sys
from datagen.cli import main
atexit.register(lambda: print(*(getattr(module, "__file__", None) for module in sys.modules.values()), sep="\\n"))
main()
"""
SMALLEST = "--resolution 16 --views 1 --test-views 1 --spp 2 --test-spp 2"


def measure_house(scratch: Path) -> dict[str, int]:
    """The counts, by what they count.

    Args:
        scratch: an empty folder, for a dataset of three tiny views.
    """
    files = {package: sorted((ROOT / package).rglob("*.py")) for package in PACKAGES}
    installed = [path for paths in files.values() for path in paths]
    tests = sorted((ROOT / "tests").rglob("*.py"))
    counts = {f"{package}: files": len(paths) for package, paths in files.items()}
    counts["installed: files"] = len(installed)
    counts["installed: lines"] = sum(map(_lines, installed))
    counts["installed: files that one other imports"] = sum(count == 1 for count in _importers(installed).values())
    counts["tests: lines"] = sum(map(_lines, tests))
    counts["imported by `datagen build glass_table`: files"] = len(imported_by_a_build(scratch))
    return counts


def _lines(path: Path) -> int:
    return len(path.read_text().splitlines())


def _importers(installed: list[Path]) -> Counter[str]:
    """How many files import each module."""
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts) for path in installed}
    found: Counter[str] = Counter()
    for path in installed:
        names = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
        found.update(names & modules)
    return found


def imported_by_a_build(scratch: Path) -> list[str]:
    """The files of ours, other than empty ones, that building a built-in scene imports."""
    words = ["build", "glass_table", *SMALLEST.split(), "--out", str(scratch / "glass_table")]
    program = BUILD.replace("main()", f"sys.argv = {['datagen', *words]!r}\nmain()")
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    files = {Path(line).relative_to(ROOT) for line in done.stdout.splitlines() if line.startswith(str(ROOT))}
    return sorted(file.as_posix() for file in files if file.parts[0] in PACKAGES and (ROOT / file).stat().st_size)
