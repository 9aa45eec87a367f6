"""Tests that whatever a file holds, reading it ends soon: in plain values, or in one line that names the file."""

import os
import re
from pathlib import Path

import pytest
from support.soon import soon

from datagen.disk.errors import HyalineError
from datagen.disk.records import MAX_JSON_BYTES, load_json, load_toml, read_regular

pytestmark = pytest.mark.promise("R6")


def refusal(read, path: Path) -> str:
    with soon(1), pytest.raises(HyalineError) as caught:
        read(path)
    message = str(caught.value)
    assert message.isprintable() and len(message) < 500
    return message.replace(str(path), "FILE")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "FILE: not a JSON file"),
        (b"[1]", "FILE: holds a list; expected a JSON object"),
        (b'{"a": NaN}', "FILE: the number 'NaN' is not finite"),
        (b'{"a": [-Infinity]}', "FILE: the number '-Infinity' is not finite"),
        (b'{"a": 1e999}', "FILE: the number '1e999' is not finite"),
        (b'{"a": 9223372036854775808}', "FILE: the number '9223372036854775808' is too large"),
        (b'{"a": ' + b"9" * 5000 + b"}", "FILE: the number '99999"),
        (b'{"a": 1, "b": 2, "a": 3}', "FILE: key 'a' stands twice in one object"),
        (b'{"a": {"b": 1, "b": 1}}', "FILE: key 'b' stands twice in one object"),
        (b'{"a": ' + b"[" * 64 + b"]" * 64 + b"}", "FILE: nested too deeply; expected at most 64 levels"),
        (b'{"a":' * 200_000, "FILE: nested too deeply; expected at most 64 levels"),
        (b'{"a": "x\\u0000y"}', "FILE: the string 'x\\x00y' holds a NUL"),
        (b'{"\\ud800": 1}', "FILE: the string '\\ud800' holds a NUL or half of a character"),
        (b'{"a": "\xff"}', "FILE: not a JSON file"),
        (b'\xef\xbb\xbf{"a": 1}', "FILE: not a JSON file"),
        (b'{"a": "' + b"x" * MAX_JSON_BYTES + b'"}', "FILE: holds 16,777,225 bytes; expected at most 16,777,216"),
    ],
)
def test_json_that_holds_surprises_is_refused_in_one_line(tmp_path: Path, text: bytes, message: str) -> None:
    path = tmp_path / "file.json"
    path.write_bytes(text)
    assert refusal(load_json, path).startswith(message)


def test_json_without_surprises_is_read_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    text = '{"a": [9223372036854775807, -1, 1e308, 5e-324, -0.0, true, null, "\\u00e9\\ud83d\\ude00"], "type": {}}'
    path.write_text(text)
    expected = [2**63 - 1, -1, 1e308, 5e-324, -0.0, True, None, "é😀"]
    assert load_json(path) == {"a": expected, "type": {}}
    path.write_text('{"a": ' + "[" * 63 + "]" * 63 + "}")
    assert list(load_json(path)) == ["a"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"a = nan", "FILE: holds the number nan"),
        (b"a = 1e999", "FILE: holds the number inf"),
        (b"a = " + b"9" * 5000, "FILE: not TOML"),
        (b"a = " + b"9" * 4000, "FILE: holds a number of 13288 bits"),
        (b'a = "\\u0000"', "FILE: the string '\\x00' holds a NUL"),
        (b"a = 1\na = 2", "FILE: not TOML (Cannot overwrite a value"),
        (b"a = " + b"[" * 100_000, "FILE: nested too deeply"),
        (b".".join([b"a"] * 100) + b" = 1", "FILE: nested too deeply"),
        (b"\xff", "FILE: not TOML"),
        (b"#" * 2_000_000, "FILE: holds 2,000,000 bytes"),
    ],
)
def test_toml_that_holds_surprises_is_refused_in_one_line(tmp_path: Path, text: bytes, message: str) -> None:
    path = tmp_path / "file.toml"
    path.write_bytes(text)
    assert refusal(load_toml, path).startswith(message)


def test_what_is_no_regular_file_is_never_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "device").symlink_to("/dev/zero")
    (tmp_path / "lost").symlink_to("nowhere")
    said = {name: refusal(read_regular, tmp_path / name) for name in ("pipe", "folder", "loop", "device", "lost")}
    assert said == {
        "pipe": "FILE: is a pipe; expected a file",
        "folder": "FILE: is a folder; expected a file",
        "loop": "FILE: its links go round in a circle; remove one of them, then run the same command again",
        "device": "FILE: is a device; expected a file",
        "lost": "FILE: the file is missing",
    }
    assert re.match("FILE: the name is too long", refusal(read_regular, tmp_path / ("x" * 300)))
    assert "cannot be the path of a file" in refusal(read_regular, tmp_path / "a\0b")
