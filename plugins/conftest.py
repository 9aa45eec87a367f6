"""What tests of plug-ins share."""

import pickle
from pathlib import Path

import pytest

from datagen.disk.errors import HyalineError
from datagen.machine import processes


@pytest.fixture(autouse=True)
def read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Foreign files are read in this process, which saves a second for each; test_confined_import.py has them read as
    commands do, in a process with limits."""

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
