"""A module of ours run in a process of its own: native code that may die or hang gets arrays, and gives arrays back."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from datagen.disk.errors import naming

ROOT = Path(__file__).resolve().parents[2]
"""Where these packages are found."""


_START = """
import resource, runpy, sys
_, hard = resource.getrlimit(resource.RLIMIT_CPU)
resource.setrlimit(resource.RLIMIT_CPU, (hard, hard))
del sys.argv[0]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""
"""A child has a time limit of its own, and not what is left of a parent's that is limited itself (`confined`)."""


class ChildError(Exception):
    """The process gave no answer; it says why in a few words."""


def child_environment() -> dict[str, str]:
    """The environment in which a child finds these packages where the parent found them; start it with -P, which keeps
    the working directory out of its path."""
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    paths = [str(ROOT), *(str(Path(path).resolve()) for path in given if path)]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def arrays_from_child(
    module: str, arrays: Mapping[str, np.ndarray], *, timeout_s: float, words: tuple[str, ...] = ()
) -> dict[str, np.ndarray]:
    """What a module writes that is started as `python -m MODULE IN.npz OUT.npz WORDS`.

    Args:
        arrays: what the module finds in IN.npz.

    Raises:
        ChildError: it died, took too long, or wrote nothing.
    """
    with tempfile.TemporaryDirectory(prefix="hyaline-child-") as folder:
        source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
        with naming(source):
            np.savez(source, allow_pickle=False, **arrays)
        try:
            answer = subprocess.run(
                [sys.executable, "-P", "-c", _START, module, str(source), str(target), *words],
                env=child_environment(),
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                timeout=timeout_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise ChildError(f"it took more than {timeout_s:.0f} s") from None
        if answer.returncode < 0:
            raise ChildError(
                f"it was ended by signal {-answer.returncode} (9: the system does that where memory runs out)"
            )
        if answer.returncode != 0 or not target.is_file():
            last = (answer.stderr.strip().splitlines() or ["no message"])[-1]
            raise ChildError(f"it ended with status {answer.returncode}: {last}")
        with np.load(target) as found:
            return dict(found)
