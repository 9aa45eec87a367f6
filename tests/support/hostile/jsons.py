"""Hostile JSON and TOML: each value of a good file replaced by what it cannot be, and text that is no such file."""

import copy
import json
from collections.abc import Callable, Iterator
from typing import Any

from support.hostile.case import Case

from datagen.disk.errors import HyalineError
from datagen.disk.storage import SEAL, seal_bytes

RAW = {"NAN": "NaN", "INFINITY": "Infinity", "HUGE": "1" + "0" * 400, "DIGITS": "9" * 5000, "EXPONENT": "1e999"}
"""Numbers that no Python number would be written as."""

VALUES: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    2**63,
    0.5,
    "",
    "\x00",
    "../../../etc/passwd",
    "/etc/passwd",
    "\x1b[31mred\x07",
    "x" * 100_000,
    "\ud800",
    [],
    {},
    [[[]]],
    {"type": []},
    {"type": "Nothing"},
    "@NAN",
    "@INFINITY",
    "@HUGE",
    "@DIGITS",
    "@EXPONENT",
)


def text_of(value: Any) -> bytes:
    """JSON with raw numbers where strings say so."""
    text = json.dumps(value, indent=1)
    for name, raw in RAW.items():
        text = text.replace(f'"@{name}"', raw)
    return text.encode("utf-8", "surrogatepass")


def sealed(value: dict[str, Any]) -> bytes:
    """The same with the seal that a careful attacker would give it."""
    value = {key: item for key, item in value.items() if key != SEAL}
    try:
        return seal_bytes(json.loads(text_of(value)))
    except (ValueError, UnicodeError, HyalineError):
        # No such file can have a seal of ours.
        return text_of({**value, SEAL: "0" * 64})


def places(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Every place in a JSON value, the whole first; of long lists the first two items."""
    yield path
    if isinstance(value, dict):
        for key, item in value.items():
            yield from places(item, (*path, key))
    elif isinstance(value, list):
        for index, item in enumerate(value[:2]):
            yield from places(item, (*path, index))


def changed(value: Any, path: tuple[str | int, ...], new: Any) -> Any:
    """A copy with another value at a place."""
    if not path:
        return new
    value = copy.deepcopy(value)
    inner = value
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = new
    return value


def without(value: Any, path: tuple[str | int, ...]) -> Any:
    """A copy that lacks a place."""
    value = copy.deepcopy(value)
    inner = value
    for key in path[:-1]:
        inner = inner[key]
    del inner[path[-1]]
    return value


def json_cases(
    reader: str, path: str, good: dict[str, Any], *, each: int, write: Callable[[Any], bytes] = text_of
) -> list[Case]:
    """A good file spoilt: `each` values at each place (another choice at each), keys lost and added.

    Args:
        write: makes the bytes; with a seal, where the file has one.
    """

    def case(name: str, value: Any, key: str | None = None) -> Case:
        return Case(name=f"{path} {name}", reader=reader, path=path, content=write(value), key=key)

    cases, turn = [], 0
    for place in places(good):
        if place in ((), (SEAL,)):
            continue
        name, key = ".".join(map(str, place)), next(part for part in reversed(place) if isinstance(part, str))
        for _ in range(each):
            new = VALUES[turn % len(VALUES)]
            turn += 1
            cases.append(case(f"{name} = {json.dumps(new)[:30]}", changed(good, place, new), key))
        if isinstance(place[-1], str):
            cases.append(case(f"without {name}", without(good, place), key))
    for key in ("mystery", "__class__", "\x1b[2J"):
        cases.append(case(f"with {json.dumps(key)}", {**good, key: 1}))
    return cases


def text_cases(reader: str, path: str, good: bytes) -> list[Case]:
    """Bytes that are not the JSON that they should be."""
    half = len(good) // 2
    contents = {
        "cut in half": good[:half],
        "without its end": good[:-3],
        "twice": good + good,
        "null": b"null",
        "list": b"[]",
        "number": b"1",
        "text": b'"text"',
        "deep": b"[" * 100_000 + b"]" * 100_000,
        "deep objects": b'{"a":' * 50_000 + b"1" + b"}" * 50_000,
        "UTF-16": good.decode().encode("utf-16"),
        "with a byte order mark": b"\xef\xbb\xbf" + good,
        "Latin-1": good.replace(b"version", b"versi\xf3n"),
        "with a comment": b"// hello\n" + good,
        "with a comma": good.rstrip().removesuffix(b"}") + b",}",
        "binary": bytes(range(256)),
        "zeros": bytes(1000),
        "a key twice": good.replace(b"{", b'{"version": 1, ', 1),
        "a pickle": b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00\x8c\x07builtin\x94.",
        "HTML": b"<!DOCTYPE html><html></html>",
    }
    return [Case(name=f"{path} {name}", reader=reader, path=path, content=data) for name, data in contents.items()]


def experiment_cases() -> list[Case]:
    """Experiment files that no sweep should start."""
    block = '[[runs]]\nmethod = "paper"\n'
    texts = {
        "unknown key": block + 'extrinsic = "sh"',
        "key in capitals": block + "STEPS = 3",
        "method that is none": '[[runs]]\nmethod = "papr"',
        "method that is a number": "[[runs]]\nmethod = 3",
        "method that is a list of lists": '[[runs]]\nmethod = [["paper"]]',
        "no method": "[[runs]]\nsteps = 3",
        "no runs": 'about = "x"',
        "runs that are a table": '[runs]\nmethod = "paper"',
        "runs that are text": 'runs = "all"',
        "runs that are empty": "runs = []",
        "runs of numbers": "runs = [1, 2]",
        "about that is a number": f"about = 3\n{block}",
        "broken": "[[runs",
        "twice the same key": f"{block}steps = 1\nsteps = 2",
        "steps of text": f'{block}steps = "many"',
        "steps below zero": f"{block}steps = -1",
        "steps of a fraction": f"{block}steps = 1.5",
        "steps too large": f"{block}steps = 9223372036854775808",
        "steps of many digits": f"{block}steps = {'9' * 5000}",
        "steps of infinity": f"{block}steps = inf",
        "rate that is no number": f"{block}lr = nan",
        "rate of infinity": f"{block}lr = inf",
        "a date": f"{block}seed = 1979-05-27",
        "a switch of text": f'{block}zero-layer = "yes"',
        "a switch of a number": f"{block}zero-layer = 1",
        "a folder": f'{block}out = "/tmp/x"',
        "an absolute folder": f'{block}out = "/etc"',
        "a name": f'{block}name = "../x"',
        "resume": f"{block}resume = true",
        "overwrite": f"{block}overwrite = true",
        "empty list": f"{block}seed = []",
        "nested list": f"{block}seed = [[1]]",
        "a table as a value": f"{block}seed = {{a = 1}}",
        "a flag as a value": f'{block}geometry = "--overwrite"',
        "a NUL in a path": f'{block}dataset = "a\\u0000b"',
        "an escape": f'{block}dataset = "\\u001b[31mred"',
        "a surrogate": f'{block}dataset = "\\ud800"',
        "extrinsics that are none": f'{block}extrinsics = "all"',
        "a flag of another method": f"{block}branches = 2",
        "methods that share no flag": '[[runs]]\nmethod = ["paper", "light-path"]\nextrinsics = "sh"',
        "help": f"{block}help = true",
        "a grid of ten thousand million runs": block
        + "".join(f"{key} = {list(range(2, 102))}\n" for key in ("seed", "steps", "batch", "features", "blocks")),
        "deep": f"{block}seed = " + "[" * 20_000 + "]" * 20_000,
        "UTF-16": None,
        "NUL": "\x00",
        "empty": "",
        "a byte order mark": "\ufeff" + block,
        "a long line": f'about = "{"x" * 1_000_000}"\n{block}',
        "JSON": '{"runs": [{"method": "paper"}]}',
    }
    return [
        Case(
            name=f"experiment {name}",
            reader="experiment",
            path="grid.toml",
            content=block.encode("utf-16") if text is None else text.encode("utf-8", "surrogatepass"),
        )
        for name, text in texts.items()
    ]
