"""Tests that no room of the house has outgrown its budget."""

import pytest
from support import house


def test_every_room_is_within_its_budget_and_no_budget_is_loose() -> None:
    assert not house.faults()


def test_a_room_that_grows_by_a_line_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    rooms = house.read_rooms()
    room = rooms["python"]["datagen/trace"]
    rooms["python"]["datagen/trace"] = house.Room(files=room.files, lines=10 * room.lines, density=room.density)
    monkeypatch.setattr(house, "read_rooms", lambda: rooms)
    assert [fault for fault in house.faults() if fault.startswith("datagen/trace:")]


def test_tokens_are_counted_without_comments_and_docstrings() -> None:
    text = 'def f(a):\n    """Doc."""\n    # Why.\n    return (\n        a + 1\n    )\n'
    assert list(house.tokens_of_lines(text)) == [6, 2, 3, 1]
