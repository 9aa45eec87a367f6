"""Tests that no name in a table ends its line or its cell, or is a formula."""

import pytest

from eval.tables.grids import Column, Grid, grid_text
from eval.tables.results import csv_text

EVIL = "a\x1b[2J\x1b]0;owned\x07\r\nerror: \u202eforged | <b> \\ [x](y) `z` & $1$"


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
