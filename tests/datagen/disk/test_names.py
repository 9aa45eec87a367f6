"""Tests that no string of a file leads out of its folder, or reaches a terminal or a table as it is."""

import os
from pathlib import Path

import pytest

from datagen.disk.errors import HyalineError
from datagen.disk.names import check_name, check_relative, file_name, find_file, printable
from datagen.terminal.command import fail, say, tell
from eval.tables.grids import Column, Grid, grid_text
from eval.tables.results import csv_text

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


def test_a_files_name_is_one_component_whatever_it_is_made_of() -> None:
    assert file_name("data/one") == "data_one"
    assert file_name("../../etc/x\x1b") == "_.._etc_x_"
    assert file_name("/") == "_" and file_name("...") == "_"


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


@pytest.mark.parametrize("look", ["table", "markdown", "latex"])
def test_a_name_in_a_table_neither_ends_its_line_nor_its_cell(look: str) -> None:
    grid = Grid(
        title=EVIL,
        columns=(Column(group="run", is_number=False), Column(group="n")),
        rows=((EVIL, "1"),),
        notes=(EVIL,),
    )
    plain = Grid(title="t", columns=grid.columns, rows=(("a", "1"),), notes=("n",))
    text = grid_text(grid, look, width=400)
    assert all(line.isprintable() for line in text.splitlines())
    assert len(text.splitlines()) == len(grid_text(plain, look, width=400).splitlines())
    if look == "markdown":
        row = next(line for line in text.splitlines() if line.startswith("| a"))
        assert row.replace(r"\|", "").count("|") == 3 and "<b>" not in row and "[x]" not in row


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@sum"])
def test_no_text_in_a_csv_is_a_formula(text: str) -> None:
    assert csv_text(text) == f"'{text}"
    assert csv_text("paper") == "paper" and csv_text(-1) == -1 and csv_text(None) is None
