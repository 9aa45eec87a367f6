"""Tests that files are committed whole, and that a sealed file notices every flipped bit."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from datagen.disk.errors import HyalineError
from datagen.disk.records import commit_sealed, load_sealed
from datagen.disk.storage import commit, commit_first, one_writer


def test_a_sealed_file_notices_any_flipped_bit(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    commit_sealed(path, {"view": 3, "files": {"a": "b"}, "noise": 1.5e-5})
    assert load_sealed(path) == {"view": 3, "files": {"a": "b"}, "noise": 1.5e-5}
    good = path.read_bytes()
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        path.write_bytes(bad)
        with pytest.raises(HyalineError, match=r"record\.json"):
            load_sealed(path)


@pytest.mark.parametrize("call", ["open", "fsync", "replace"])
def test_a_commit_that_dies_at_any_step_leaves_the_old_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    path = tmp_path / "file"
    commit(path, b"old")

    def die(*arguments: object, **options: object) -> None:
        raise OSError(28, "No space left on device", str(path))

    target = {"open": (Path, "open"), "fsync": (os, "fsync"), "replace": (Path, "replace")}[call]
    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr(*target, die)
        commit(path, b"new")
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("write", [commit, commit_first])
def test_a_write_that_is_interrupted_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path, bytes], None]
) -> None:
    monkeypatch.setattr(os, "fsync", lambda _: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "page.html", b"new")
    assert list(tmp_path.iterdir()) == []


def test_only_one_process_writes_to_a_folder(tmp_path: Path) -> None:
    program = f"""
from pathlib import Path
from datagen.disk.storage import one_writer
with one_writer(Path({str(tmp_path)!r})):
    print("in", flush=True)
    input()
"""
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"in\n"
        with pytest.raises(HyalineError, match="another process is writing there"), one_writer(tmp_path):
            pass
        other.kill()
    with one_writer(tmp_path):
        assert list(tmp_path.iterdir()) == []
