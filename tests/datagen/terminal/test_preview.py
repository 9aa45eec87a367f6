"""Tests thumbnails in a terminal: the colours of each half character, and silence where they cannot be seen."""

import io
import re
import sys

import numpy as np
import pytest

from datagen.terminal.preview import COLUMNS, half_blocks, preview

RED, BLUE = (255, 0, 0), (0, 0, 255)


class Terminal(io.StringIO):
    """A terminal that remembers what was printed."""

    def isatty(self) -> bool:
        return True


def two_colors(height: int, width: int) -> np.ndarray:
    """Red above blue."""
    picture = np.zeros((height, width, 3), np.uint8)
    picture[: height // 2], picture[height // 2 :] = RED, BLUE
    return picture


def shown(monkeypatch: pytest.MonkeyPatch, *, out: io.StringIO, colors: str = "truecolor", columns: int = 100) -> str:
    err = Terminal()
    for name, value in {"COLORTERM": colors, "TERM": "xterm-256color", "COLUMNS": str(columns)}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("NO_COLOR", raising=False)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", out)
        patch.setattr(sys, "stderr", err)
        preview([two_colors(64, 64)] * 5, "five pictures")
    assert out.getvalue() == ""
    return err.getvalue()


def test_each_character_has_the_colours_of_two_pixels() -> None:
    rows = half_blocks(two_colors(60, 40))
    assert (len(rows), len(rows[0])) == (30, COLUMNS)
    assert rows[0][0] == ("#ff0000", "#ff0000") and rows[-1][-1] == ("#0000ff", "#0000ff")
    (middle,) = {row[7] for row in half_blocks(two_colors(2, 40))}
    assert middle == ("#ff0000", "#0000ff")


def test_as_many_pictures_as_fit_stand_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    text = shown(monkeypatch, out=Terminal())
    lines = text.splitlines()
    assert lines[-1] == "five pictures" and len(lines) == COLUMNS // 2 + 1
    assert "38;2;255;0;0;48;2;255;0;0m" in lines[0] and "38;2;0;0;255;48;2;0;0;255m" in lines[-2]
    assert {re.sub(r"\x1b\[[0-9;]*m", "", line) for line in lines[:-1]} == {"▀" * COLUMNS + "  " + "▀" * COLUMNS}


def test_nothing_is_shown_where_it_could_not_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shown(monkeypatch, out=io.StringIO()) == ""
    assert shown(monkeypatch, out=Terminal(), colors="") == ""
