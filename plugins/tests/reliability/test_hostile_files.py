"""Tests that hostile files are refused in one line that names the file, or accepted, and run and read nothing else."""

import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.hostile import READERS, Case, cases_of, write_world
from support.soon import TookTooLong, ending_within

from datagen.disk.errors import HyalineError, printable

pytestmark = pytest.mark.promise("R6", "R7")

STEP = 24
"""A quick run tries one of so many files."""
SECONDS = 10
"""A file may take so long."""

heard: list[str] = []
"""Files of the folder `secrets` that were opened."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("hostile") / "world"
    write_world(root)

    def hear(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            path = os.path.realpath(os.fsdecode(arguments[0]))
            if path.startswith(("/etc/passwd", str(root.parent / "secrets"))):
                heard.append(path)

    sys.addaudithook(hear)
    return root


def test_hostile_files_are_refused_in_one_line_or_accepted(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_full: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(world.parent))
    cases = cases_of(world)
    assert len(cases) > 1000
    heard.clear()
    wrong, refused, unnamed = [], 0, 0
    for case in cases[:: 1 if is_full else STEP]:
        path = world / case.path
        good = path.read_bytes()
        path.unlink()
        case.place(world)
        said = outcome(case, world)
        refused += said.startswith("refused")
        unnamed += said.startswith("refused") and case.path not in said and path.parent.name not in said
        if said.startswith("wrong") or heard or any(tmp_path.iterdir()):
            wrong.append(f"{case.name}: {said} {heard}")
            heard.clear()
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)
        path.write_bytes(good)
    assert not wrong, f"{len(wrong)} of {len(cases)}:\n" + "\n".join(wrong[:40])
    assert unnamed < 0.2 * refused, f"{unnamed} of {refused} errors do not name the file"
    for read in READERS.values():
        read(world)  # Good files are accepted.


def outcome(case: Case, world: Path) -> str:
    """What came of reading a file."""
    try:
        with ending_within(SECONDS), np.errstate(over="ignore"):
            READERS[case.path](world)
    except HyalineError as error:
        said = printable(str(error))
        return f"refused: {said}" if len(said) < 1500 else f"wrong: {said!r}"
    except TookTooLong:
        return f"wrong: took more than {SECONDS} s"
    except Exception as error:
        return f"wrong: {type(error).__name__}: {error}"
    return "wrong: accepted" if case.is_bad else "accepted"
