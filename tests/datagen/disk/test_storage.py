"""Tests that files are named, read and committed so that nothing leaves its folder, hangs, or is half written."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.soon import soon

from datagen.disk.errors import HyalineError, printable
from datagen.disk.records import commit_sealed, load_sealed
from datagen.disk.storage import check_name, check_relative, commit, commit_first, find_file, one_writer, read_regular
from datagen.terminal.command import fail, say, tell

EVIL = "a\x1b[2J\x1b]0;owned\x07\r\nerror: \u202eforged | <b> \\ [x](y) `z` & $1$"


@pytest.mark.parametrize(
    "text", ["../../x", "/tmp/x", "a/b", "..", ".hidden", "-rf", "", "a b", "a\x00", "ä", "x" * 300]
)
def test_what_is_no_plain_name_is_refused(text: str) -> None:
    with pytest.raises(HyalineError, match=r"scene name: is .*; expected a name of letters"):
        check_name(text, where="scene name")


@pytest.mark.parametrize("text", ["../x", "/x", "a//b", "a/./b", "a/../../b", "", "a\nb", "a\\b"])
def test_a_path_that_could_lead_elsewhere_is_refused(text: str) -> None:
    with pytest.raises(HyalineError, match="expected a file inside the folder"):
        check_relative(text, where="files")


def test_links_out_pipes_and_folders_are_no_files(tmp_path: Path) -> None:
    root, outside = tmp_path / "root", tmp_path / "outside"
    root.mkdir()
    outside.write_text("secret")
    (root / "inside").write_text("mine")
    (root / "link").symlink_to("inside")
    (root / "out").symlink_to(outside)
    (root / "circle").symlink_to("circle")
    (root / "folder").mkdir()
    os.mkfifo(root / "pipe")
    assert find_file(root, "link", where="w").read_text() == "mine"
    assert find_file(root, "missing", where="w") == root / "missing"
    for name in ("out", "circle", "folder", "pipe"):
        with pytest.raises(HyalineError, match=f"w: {name} "):
            find_file(root, name, where="w")


def test_control_characters_are_spelled_out_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert printable("plain – ∞ ↑") == "plain – ∞ ↑"  # noqa: RUF001
    say(EVIL)
    tell(EVIL)
    with pytest.raises(SystemExit):
        fail(EVIL)
    said = capsys.readouterr()
    for text, lines in ((said.out, 1), (said.err, 2)):
        assert text.count("\n") == lines
        assert all(line.isprintable() for line in text.splitlines())
    assert r"\x1b[2J" in said.out


@pytest.mark.promise("R6")
def test_what_is_no_regular_file_is_never_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "device").symlink_to("/dev/zero")
    (tmp_path / "lost").symlink_to("nowhere")
    for name in ("pipe", "folder", "loop", "device", "lost", "x" * 300):
        with soon(1), pytest.raises(HyalineError, match=name[:200]):
            read_regular(tmp_path / name)
    with pytest.raises(HyalineError, match="cannot be the path of a file"):
        read_regular(tmp_path / "a\0b")


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
    refused = pytest.raises(HyalineError, match="another process is writing there")
    with one_writer(tmp_path, shared=True), one_writer(tmp_path, shared=True), refused, one_writer(tmp_path):
        pass
