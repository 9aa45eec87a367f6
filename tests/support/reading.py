"""Foreign files are read in the process of the tests."""

import pickle
from pathlib import Path

import pytest

from datagen.disk.errors import HyalineError
from datagen.machine import processes


@pytest.fixture(autouse=True)
def read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Saves a second for each file; test_confined_import.py has them read as commands do, in a process with limits."""

    def run(folder: Path) -> int:
        function, arguments, *_ = pickle.loads((folder / "call").read_bytes())
        (folder / "said").touch()
        end = ""
        try:
            function(folder / "answer", *arguments)
        except HyalineError as error:
            end = str(error)
        (folder / "end.txt").write_text(end)
        return 0

    monkeypatch.setattr(processes, "_run", run)
