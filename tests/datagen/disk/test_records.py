"""Tests how records become JSON and come back."""

from dataclasses import dataclass
from typing import Literal

import pytest

from datagen.disk.errors import HyalineError
from datagen.disk.records import from_json, to_json


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colour": 1}, r"here: unknown key 'colour'; known are color, count"),
        ({"color": "green"}, r"here\.color: is 'green'; expected one of 'red', 'blue'"),
        ({"count": True}, r"here\.count: is True; expected an integer"),
        ({"count": 1.5}, r"here\.count: is 1\.5; expected an integer"),
        ({"shape": {"type": "Hexagon"}}, r"here\.shape\.type: is 'Hexagon'; expected one of \['Round', 'Square'\]"),
        ({"shape": {"type": "Square", "side": [1]}}, r"here\.shape\.side: .*expected a list of 2"),
        ({"parts": [{"type": "Round"}]}, r"here\.parts\[0\]: key 'radius' is missing"),
    ],
)
def test_a_wrong_value_is_named_with_its_place(change: dict, message: str) -> None:
    with pytest.raises(HyalineError, match=message):
        from_json(Thing, {**to_json(THING), **change}, where="here")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": {"type": []}}, r"here\.shape\.type: is \[\]; expected one of"),
        ({"shape": {"type": "Round", "radius": float("nan")}}, r"radius: is nan; expected a finite number"),
        ({"shape": {"type": "Round", "radius": 10**400}}, r"radius: is 1000.*\.\.\..*000; expected a finite number"),
        ({"shape": {"type": "Round", "radius": True}}, r"radius: is True; expected a finite number"),
        ({"count": 2**63}, r"here\.count: is 9223372036854775808; expected an integer"),
        ({"color": ["red"]}, r"here\.color: is \['red'\]; expected one of"),
        ({"type": "Round"}, r"here\.type: is 'Round'; expected 'Thing', or no such key"),
        ({"parts": [1] * 20_000}, r"here\.parts: has 20,000 items; expected at most 10,000"),
        ({"note": ["x" * 1000] * 1000}, r"here\.note: is \['xxx.{200,400}\]; expected text$"),
    ],
)
def test_a_hostile_value_is_refused_in_a_short_line(change: dict, message: str) -> None:
    with pytest.raises(HyalineError, match=message) as caught:
        from_json(Thing, {**to_json(THING), **change}, where="here")
    assert len(str(caught.value)) < 500
