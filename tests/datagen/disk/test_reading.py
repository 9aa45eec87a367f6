"""Tests that whatever a file holds, reading it ends soon: in plain values, or in one line that names the file."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from support.soon import soon

from datagen.disk.errors import HyalineError
from datagen.disk.records import MAX_JSON_BYTES, load_json
from datagen.disk.storage import read_regular

pytestmark = pytest.mark.promise("R6")


def refusal(read: Callable[[Path], object], path: Path) -> str:
    with soon(1), pytest.raises(HyalineError) as caught:
        read(path)
    message = str(caught.value)
    assert message.isprintable() and len(message) < 500
    return message.replace(str(path), "FILE")


@pytest.mark.parametrize(
    "text",
    [
        *(b"", b"[1]", b'{"a": NaN}', b'{"a": [-Infinity]}', b'{"a": 1e999}', b'{"a": 9223372036854775808}'),
        *(b'{"a": ' + b"9" * 5000 + b"}", b'{"a": ' + b"[" * 64 + b"]" * 64 + b"}", b'{"a":' * 200_000),
        *(b'{"\\ud800": 1}', b'{"a": "\xff"}', b'\xef\xbb\xbf{"a": 1}', b'{"a": "' + b"x" * MAX_JSON_BYTES + b'"}'),
    ],
)
def test_json_that_holds_surprises_is_refused_in_one_line(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "file.json"
    path.write_bytes(text)
    assert refusal(load_json, path).startswith("FILE: ")


def test_json_without_surprises_is_read_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    text = '{"a": [9223372036854775807, -1, 1e308, 5e-324, -0.0, true, null, "\\u00e9\\ud83d\\ude00"], "type": {}}'
    path.write_text(text)
    expected = [2**63 - 1, -1, 1e308, 5e-324, -0.0, True, None, "é😀"]
    assert load_json(path) == {"a": expected, "type": {}}
    path.write_text('{"a": ' + "[" * 63 + "]" * 63 + "}")
    assert list(load_json(path)) == ["a"]


def test_what_is_no_regular_file_is_never_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "device").symlink_to("/dev/zero")
    (tmp_path / "lost").symlink_to("nowhere")
    for name in ("pipe", "folder", "loop", "device", "lost", "x" * 300):
        assert refusal(read_regular, tmp_path / name).startswith("FILE: ")
    assert "cannot be the path of a file" in refusal(read_regular, tmp_path / "a\0b")
