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
