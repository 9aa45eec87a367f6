"""Tests that a module run in a process of its own gives its arrays back, or says in a line why it does not."""

import sys
from pathlib import Path

import numpy as np
import pytest

from datagen.machine.processes import ChildError, arrays_from_child

CHILDREN = {
    "twice": "np.savez(sys.argv[2], twice=2 * np.load(sys.argv[1])['values'])",
    "silent": "pass",
    "failing": "sys.exit('no luck today')",
    "killed": "os.kill(os.getpid(), 9)",
    "slow": "while True: pass",
}


@pytest.fixture
def children(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The modules, in a folder of PYTHONPATH that is given relative to the working directory."""
    for name, code in CHILDREN.items():
        (tmp_path / f"child_{name}.py").write_text(f"import os, sys, time\nimport numpy as np\n{code}\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", ".")


def test_arrays_go_there_and_come_back(children: None) -> None:
    values = np.arange(6.0).reshape(2, 3)
    found = arrays_from_child("child_twice", {"values": values}, cpu_s=60)
    np.testing.assert_array_equal(found["twice"], 2 * values)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("silent", "it ended with status 0: no message"),
        ("failing", "it ended with status 1: no luck today"),
        ("killed", "it was ended by signal 9"),
        ("slow", "it took more than 1 CPU seconds"),
        ("missing", "it ended with status 1: .*No module named child_missing"),
    ],
)
def test_why_there_is_no_answer_is_said(children: None, name: str, message: str) -> None:
    with pytest.raises(ChildError, match=message):
        arrays_from_child(f"child_{name}", {}, cpu_s=1 if name == "slow" else 60)


def test_the_working_directory_hides_no_module_of_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit('a stranger ran')")
    (tmp_path / "datagen.py").write_text("raise SystemExit('a stranger ran')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    assert "child" not in sys.modules
    with pytest.raises(ChildError) as error:
        arrays_from_child("proxies.kinds.wrap", {}, cpu_s=60)
    assert "stranger" not in str(error.value)
