"""A module of ours run in a process of its own: native code that may die or hang gets arrays, and gives arrays back."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from datagen.disk.os_errors import naming

ROOT = Path(__file__).resolve().parents[2]
"""Where these packages are found."""


class ChildError(Exception):
    """The process gave no answer; it says why in a few words."""


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
        # The child finds these packages where the parent found them; -P keeps the working directory out of its path.
        given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
        paths = [str(ROOT), *(str(Path(path).resolve()) for path in given if path)]
        try:
            answer = subprocess.run(
                [sys.executable, "-P", "-m", module, str(source), str(target), *words],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
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
