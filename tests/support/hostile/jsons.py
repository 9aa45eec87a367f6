"""Hostile files, among them JSON and TOML: each value replaced by what it cannot be, and text that is no such file."""

import copy
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.disk.errors import HyalineError
from datagen.disk.storage import SEAL, seal_bytes


@dataclass(frozen=True, kw_only=True)
class Case:
    """One file or folder that is not what its reader hopes for."""

    name: str
    reader: str
    """A key of `readers.READERS`."""
    path: str
    """Relative to the world that the readers read."""
    content: bytes | Callable[[Path], object]
    """What lies there, or what puts it there."""
    key: str | None = None
    """The last name on the way to the value that is wrong in it, if it is one value."""

    def place(self, world: Path) -> None:
        """Puts it where the world has nothing."""
        path = world / self.path
        path.write_bytes(self.content) if isinstance(self.content, bytes) else self.content(path)


NOT_FILES: dict[str, Callable[[Path], object]] = {
    "nothing": lambda place: None,
    "folder": Path.mkdir,
    "pipe": os.mkfifo,
    "link to itself": lambda place: place.symlink_to(place.name),
    "link to nothing": lambda place: place.symlink_to("nowhere"),
    "link to a secret": lambda place: place.symlink_to(os.environ["HYALINE_SECRET"]),
    "endless": lambda place: place.symlink_to("/dev/zero"),
    "empty": Path.touch,
}
"""Things that lie where a file belongs."""


def named(kind: str, reader: str, path: str, contents: dict[str, bytes]) -> list[Case]:
    """A case for each content by its name."""
    return [Case(name=f"{kind} {name}", reader=reader, path=path, content=data) for name, data in contents.items()]


def not_files(reader: str, path: str, *, may_be_link: bool = False) -> list[Case]:
    """Each of them.

    Args:
        may_be_link: to a file anywhere: what a person names, and runs, which are no scene from elsewhere.
    """
    return [
        Case(name=f"{path} {name}", reader=reader, path=path, content=make)
        for name, make in NOT_FILES.items()
        if not (may_be_link and name == "link to a secret")
    ]


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


def changed(value: Any, path: tuple[str | int, ...], *new: Any) -> Any:
    """A copy with another value at a place, or without that place."""
    value = copy.deepcopy(value)
    inner = value
    for key in path[:-1]:
        inner = inner[key]
    if new:
        (inner[path[-1]],) = new
    else:
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
            cases.append(case(f"without {name}", changed(good, place), key))
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
        "number": b"1",
        "deep": b"[" * 100_000 + b"]" * 100_000,
        "UTF-16": good.decode().encode("utf-16"),
        "with a byte order mark": b"\xef\xbb\xbf" + good,
        "Latin-1": good.replace(b"version", b"versi\xf3n"),
        "binary": bytes(range(256)),
        "a key twice": good.replace(b"{", b'{"version": 1, ', 1),
        "a pickle": b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00\x8c\x07builtin\x94.",
    }
    return named(path, reader, path, contents)


def experiment_cases() -> list[Case]:
    """Experiment files that no sweep should start."""
    line = "model train paper"
    texts = {
        "unknown flag": f"{line} --extrinsic sh",
        "flag in capitals": f"{line} --STEPS 3",
        "method that is none": "model train papr",
        "method that is a number": "model train 3",
        "no method": "model train --steps 3",
        "no runs": "datagen build one",
        "no program": "train paper",
        "another program": f"rm -r data\n{line}",
        "an open quote": f"{line} 'one",
        "open braces": f"{line} --seed {{0,1",
        "steps of text": f"{line} --steps many",
        "steps below zero": f"{line} --steps -1",
        "steps of a fraction": f"{line} --steps 1.5",
        "steps too large": f"{line} --steps 9223372036854775808",
        "steps of many digits": f"{line} --steps {'9' * 5000}",
        "steps of infinity": f"{line} --steps inf",
        "rate that is no number": f"{line} --lr nan",
        "a switch of text": f"{line} --zero-layer yes",
        "a flag of another method": f"{line} --branches 2",
        "methods that share no flag": "model train {paper,light-path} --extrinsics sh",
        "a surrogate": f'{line} "\ud800"',
        "a grid of ten thousand million runs": f"{line} --seed {'{0,1,2,3,4,5,6,7,8,9}' * 10}",
        "many lines": f"{line} --steps 1\n" * 20_000,
        "deep": f"{line} --seed " + "{" * 20_000 + "}" * 20_000,
        "UTF-16": None,
        "NUL": "\x00",
        "empty": "",
        "a long line": f"{line} # {'x' * 1_000_000}",
    }
    contents = {
        name: line.encode("utf-16") if text is None else text.encode("utf-8", "surrogatepass")
        for name, text in texts.items()
    }
    return named("experiment", "experiment", "grid.txt", contents)
