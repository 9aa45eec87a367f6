"""What tests of plug-ins share."""

import json
import pickle
from pathlib import Path

import pytest

from datagen.disk.errors import HyalineError
from datagen.machine import confined


@pytest.fixture(autouse=True)
def read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Foreign files are read in this process, which saves a second for each; test_confined_import.py has them read as
    commands do, in a process with limits."""

    def run(folder: Path, said: int) -> int:
        function, arguments, *_ = pickle.loads((folder / "call").read_bytes())
        end = {}
        try:
            function(folder / "answer", *arguments)
        except HyalineError as error:
            end = {"error": str(error)}
        (folder / "end.json").write_text(json.dumps(end))
        return 0

    monkeypatch.setattr(confined, "_run", run)
