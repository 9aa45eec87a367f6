"""Hostile values for every place in a JSON or TOML file: what a parser and those who trust it have tripped over."""

import copy
from collections.abc import Iterator
from typing import Any

JSON_TEXTS = {
    "null": "null",
    "true": "true",
    "negative": "-1",
    "zero": "0",
    "huge float": "1e308",
    "tiny float": "5e-324",
    "beyond float": "1e999",
    "NaN": "NaN",
    "Infinity": "Infinity",
    "63 bits": str(2**63 - 1),
    "64 bits": str(2**64),
    "400 digits": "1" + "0" * 400,
    "5000 digits": "9" * 5000,
    "empty list": "[]",
    "empty object": "{}",
    "unhashable type": '{"type": []}',
    "object as type": '{"type": {"a": 1}}',
    "NUL": '"a\\u0000b"',
    "surrogate": '"\\ud800"',
    "escape": '"\\u001b[2J"',
    "path": '"../../../etc/passwd"',
    "absolute": '"/etc/passwd"',
    "long text": '"' + "x" * 100_000 + '"',
    "long list": "[" + "0," * 50_000 + "0]",
    "deep list": "[" * 50_000 + "]" * 50_000,
    "half as deep": "[" * 300 + "]" * 300,
    "key twice": '{"a": 1, "a": 2}',
}
"""The text of each value, by what it is."""

PLACEHOLDER = "HOSTILE VALUE"


def places(data: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Every place in a JSON value at which another value can stand, that of lists' first items alone."""
    entries = data.items() if isinstance(data, dict) else enumerate(data[:1]) if isinstance(data, list) else ()
    for key, value in entries:
        yield (*path, key)
        yield from places(value, (*path, key))


def replaced(data: Any, path: tuple[str | int, ...], value: Any) -> Any:
    """A copy of a JSON value with another value at one place."""
    changed = copy.deepcopy(data)
    inner = changed
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return changed


def without(data: Any, path: tuple[str | int, ...]) -> Any:
    """A copy of a JSON value that lacks one place."""
    changed = copy.deepcopy(data)
    inner = changed
    for key in path[:-1]:
        inner = inner[key]
    del inner[path[-1]]
    return changed
