"""Tests how records become JSON and come back, and that any JSON file is soon read, or refused in one line."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest
from support.soon import soon

from datagen.disk.errors import HyalineError
from datagen.disk.records import MAX_JSON_BYTES, from_json, load_json, to_json


@dataclass(frozen=True, kw_only=True)
class Round:
    radius: float


@dataclass(frozen=True, kw_only=True)
class Square:
    side: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Thing:
    shape: Round | Square
    color: Literal["red", "blue"]
    count: int = 3
    note: str | None = None
    parts: tuple[Round, ...] = ()


THING = Thing(shape=Square(side=(1.0, 2.5)), color="blue", parts=(Round(radius=0.1), Round(radius=2)))


def test_a_record_survives_the_way_to_json_and_back() -> None:
    assert from_json(Thing, to_json(THING), where="here") == THING


HUGE = 10**400


@pytest.mark.parametrize(
    ("change", "place"),
    [
        ({"colour": 1}, "here: unknown key 'colour'"),
        ({"color": "green"}, "here.color: is 'green'; expected one of 'red', 'blue'"),
        ({"color": ["red"]}, "here.color: is"),
        ({"count": True}, "here.count: is True; expected an integer"),
        ({"count": 1.5}, "here.count: is"),
        ({"count": 2**63}, "here.count: is"),
        ({"shape": {"type": "Hexagon"}}, "here.shape.type: is 'Hexagon'; expected one of ['Round', 'Square']"),
        ({"shape": {"type": []}}, "here.shape.type: is"),
        ({"shape": 1}, "here.shape: 1 has no `type`"),
        ({"shape": {"type": "Square", "side": [1]}}, "here.shape.side: is [1]; expected a list of 2"),
        ({"shape": {"type": "Round", "radius": HUGE}}, "here.shape.radius: is 1000"),
        ({"shape": {"type": "Round", "radius": True}}, "here.shape.radius: is True; expected a finite number"),
        ({"parts": [{"type": "Round"}]}, "here.parts[0]: key 'radius' is missing"),
        ({"type": "Round"}, "here.type: is 'Round'; expected 'Thing', or no such key"),
        ({"note": ["x" * 1000] * 1000}, "here.note: is ['xxx"),
    ],
)
def test_a_wrong_value_is_named_with_its_place_in_a_short_line(change: dict, place: str) -> None:
    with pytest.raises(HyalineError) as caught:
        from_json(Thing, {**to_json(THING), **change}, where="here")
    assert str(caught.value).startswith(place) and len(str(caught.value)) < 500


@pytest.mark.promise("R6")
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
    with soon(1), pytest.raises(HyalineError) as caught:
        load_json(path)
    message = str(caught.value)
    assert message.isprintable() and message.startswith(f"{path}: ") and len(message) < 500 + len(str(path))


def test_json_without_surprises_is_read_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    text = '{"a": [9223372036854775807, -1, 1e308, 5e-324, -0.0, true, null, "\\u00e9\\ud83d\\ude00"], "type": {}}'
    path.write_text(text)
    expected = [2**63 - 1, -1, 1e308, 5e-324, -0.0, True, None, "é😀"]
    assert load_json(path) == {"a": expected, "type": {}}
    path.write_text('{"a": ' + "[" * 63 + "]" * 63 + "}")
    assert list(load_json(path)) == ["a"]
