"""JSON and TOML files that anybody may have written, and the frozen records that they describe.

Whatever a file holds, reading it ends soon, and either gives plain values or raises one HyalineError that names the
file: no pipe or device is ever opened, numbers are finite and fit into 64 bits, nesting is shallow, and no key stands
twice. Records become JSON and come back strictly, by the types of their fields.
"""

import contextlib
import dataclasses
import errno
import json
import math
import os
import reprlib
import stat
import sys
import tomllib
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from datagen.disk.errors import DamagedError, HyalineError, describe_os_error

if typing.TYPE_CHECKING:
    Json = typing.Union[None, bool, int, float, str, list["Json"], dict[str, "Json"]]  # noqa: UP007
else:
    Json = None | bool | int | float | str | list | dict  # What checks annotations at run time takes no recursion.
T = typing.TypeVar("T")
Value = typing.TypeVar("Value")

MAX_JSON_BYTES = 16 << 20
"""The largest that is written here holds the cameras of 10,000 views."""
MAX_TOML_BYTES = 1 << 18
MAX_NESTING = 64
MAX_DIGITS = 20
"""Longest integer accepted in JSON; 64-bit integers have at most 19 digits."""

_OUT_OF_RESOURCES = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EINTR)
"""Errors of the machine, not of the file: they are no reason to call it damaged and to make it again."""

MAX_ITEMS = 10_000
"""Most items of a list in a record; checking longer ones would only delay their refusal."""

_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 80
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = 4
_REPR.maxlevel = 3


def shown(value: object) -> str:
    """A value as an error shows it: like `repr`, but in one short line whatever it is."""
    return _REPR.repr(value)


def to_json(value: object) -> Json:
    """Plain JSON for a frozen record, a tuple, a mapping or a scalar; a record in a union carries its `type`."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: to_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
        name = type(value).__name__
        # Private records describe a file's layout; they are never part of a union and need no tag.
        return fields if name.startswith("_") else {"type": name, **fields}
    if isinstance(value, (tuple, list)):
        return [to_json(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Path):
        return value.as_posix()
    if (tolist := getattr(value, "tolist", None)) is not None:  # Numbers and arrays of NumPy.
        return to_json(tolist())
    raise TypeError(f"{value!r}: a {type(value).__name__} has no JSON form here")


def from_json(kind: type[T], data: Json, *, where: str) -> T:
    """The record of class `kind` that `data` describes; the inverse of `to_json`.

    Raises:
        HyalineError: an unknown or missing key, or a value of the wrong type, named with its place.
    """
    return typing.cast(T, _parse(kind, data, where))


def _parse(kind: object, data: Json, where: str) -> object:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal:
        # Of the same type, too: 1 equals true and 1.0.
        is_known = any(type(data) is type(choice) and data == choice for choice in arguments)
        return _checked(data, is_known, where, f"one of {', '.join(map(repr, arguments))}")
    if origin in (typing.Union, types.UnionType):
        return _parse_union(arguments, data, where)
    if origin is tuple:
        return _parse_tuple(arguments, data, where)
    if origin is dict:
        entries = _checked(data, isinstance(data, dict), where, "an object").items()
        return {key: _parse(arguments[1], item, f"{where}[{shown(key)}]") for key, item in entries}
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _parse_record(kind, data, where)
    if kind is float:
        is_number = isinstance(data, (int, float)) and not isinstance(data, bool) and abs(data) <= sys.float_info.max
        return float(_checked(data, is_number, where, "a finite number"))
    if kind is int:
        is_integer = isinstance(data, int) and not isinstance(data, bool) and -(2**63) <= data < 2**63
        return _checked(data, is_integer, where, "an integer")
    if kind is bool:
        return _checked(data, isinstance(data, bool), where, "true or false")
    if kind is str:
        return _checked(data, isinstance(data, str), where, "text")
    raise TypeError(f"{where}: no JSON form for the annotation {kind!r}")


def _parse_union(choices: tuple[object, ...], data: Json, where: str) -> object:
    if data is None and types.NoneType in choices:
        return None
    records = {
        choice.__name__: choice for choice in choices if isinstance(choice, type) and dataclasses.is_dataclass(choice)
    }
    if isinstance(data, dict) and records:
        name = data.get("type")
        _checked(name, isinstance(name, str) and name in records, f"{where}.type", f"one of {sorted(records)}")
        return _parse_record(records[typing.cast(str, name)], data, where)
    plain = [choice for choice in choices if choice not in records.values() and choice is not types.NoneType]
    if str in plain and len(plain) == 2:  # Text, or what is none.
        plain = [choice for choice in plain if (choice is str) == isinstance(data, str)]
    if len(plain) != 1:
        raise HyalineError(f"{where}: {shown(data)} has no `type`; expected one of {sorted(records)}")
    return _parse(plain[0], data, where)


def _parse_tuple(items: tuple[object, ...], data: Json, where: str) -> tuple[object, ...]:
    values = _checked(data, isinstance(data, list), where, "a list")
    if len(values) > MAX_ITEMS:
        raise HyalineError(f"{where}: has {len(values):,} items; expected at most {MAX_ITEMS:,}")
    kinds = [items[0]] * len(values) if len(items) == 2 and items[1] is Ellipsis else list(items)
    _checked(data, len(kinds) == len(values), where, f"a list of {len(kinds)}")
    return tuple(_parse(kind, item, f"{where}[{i}]") for i, (kind, item) in enumerate(zip(kinds, values, strict=True)))


def _parse_record(kind: type, data: Json, where: str) -> object:
    entries = _checked(data, isinstance(data, dict), where, "an object")
    hints = typing.get_type_hints(kind)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    tag = entries.get("type", kind.__name__)
    if "type" not in fields and tag != kind.__name__:
        raise HyalineError(f"{where}.type: is {shown(tag)}; expected {kind.__name__!r}, or no such key")
    if unknown := sorted(set(entries) - set(fields) - {"type"}):
        raise HyalineError(f"{where}: unknown key {shown(unknown[0])}; known are {', '.join(sorted(fields))}")
    required = {
        name
        for name, field in fields.items()
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    }
    if missing := sorted(required - set(entries)):
        raise HyalineError(f"{where}: key {missing[0]!r} is missing; expected {', '.join(sorted(required))}")
    values = {name: _parse(hints[name], entries[name], f"{where}.{name}") for name in fields if name in entries}
    try:
        return kind(**values)
    except HyalineError as error:  # A record names its field, not where it was read.
        raise HyalineError(f"{where}: {error}") from None


def _checked(data: typing.Any, is_good: bool, where: str, expected: str) -> typing.Any:
    if not is_good:
        raise HyalineError(f"{where}: is {shown(data)}; expected {expected}")
    return data


def entry(data: Mapping[str, Value], key: str, *, where: object) -> Value:
    """The value of a key that has to be there.

    Raises:
        HyalineError: it is not.
    """
    if key not in data:
        raise HyalineError(f"{where}: key {key!r} is missing; build it again")
    return data[key]


# Files


def open_regular(path: Path) -> BinaryIO:
    """A regular file, opened for reading; links are followed.

    Raises:
        HyalineError: it is missing, or a folder, a pipe or a device, or it cannot be read.
        OSError: this process is out of memory or file handles.
    """
    try:
        with _refusing(path):
            # A pipe would wait for its writer, and a device may do anything: they are never opened.
            _check_regular(path, path.stat().st_mode)
            file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    except ValueError as error:  # A NUL, or half of a surrogate pair.
        raise HyalineError(f"{shown(str(path))}: cannot be the path of a file ({error})") from error
    try:
        _check_regular(path, os.fstat(file.fileno()).st_mode)
    except HyalineError:
        file.close()
        raise
    return file


def read_regular(path: Path, *, at_most: int | None = None) -> bytes:
    """The bytes of a regular file.

    Raises:
        HyalineError: see `open_regular`; or it holds more than `at_most` bytes.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if at_most is not None and size > at_most:
            raise HyalineError(f"{path}: holds {size:,} bytes; expected at most {at_most:,}")
        with _refusing(path):
            return file.read()


def load_json(path: Path) -> dict[str, Json]:
    """A JSON object from a file.

    Raises:
        HyalineError: missing, not UTF-8 JSON, not an object, a key that stands twice in one object, a number that is
            not finite or does not fit into 64 bits, or a string that is not valid Unicode.
    """
    return parse_json(read_regular(path, at_most=MAX_JSON_BYTES), where=str(path))


def parse_json(text: bytes, *, where: str) -> dict[str, Json]:
    """A JSON object from the bytes of a file; see `load_json`."""
    try:
        data = json.loads(
            text.decode(), parse_int=_integer, parse_float=_number, parse_constant=_number, object_pairs_hook=_object
        )
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DamagedError(f"{where}: not a JSON file ({error})") from error
    except RecursionError:
        raise DamagedError(f"{where}: nested too deeply; expected at most {MAX_NESTING} levels") from None
    except HyalineError as error:
        raise DamagedError(f"{where}: {error}") from None
    if not isinstance(data, dict):
        raise DamagedError(f"{where}: holds a {type(data).__name__}; expected a JSON object")
    containers = _containers(data, where=where)  # Numbers and keys were checked as they were read.
    if b"\\u" in text:
        _check_texts(containers, where)
    return data


def load_toml(path: Path) -> dict[str, object]:
    """The content of a TOML file; what is said of `load_json` holds for it, too.

    Raises:
        HyalineError: see there.
    """
    text = read_regular(path, at_most=MAX_TOML_BYTES)
    # The time that tomllib takes for a key such as a.a.a grows with the cube of its length. (Numbers have commas.)
    if any(line.count(b".") > MAX_NESTING + line.count(b",") for line in text.splitlines()):
        raise DamagedError(f"{path}: nested too deeply; expected at most {MAX_NESTING} levels")
    try:
        # TOML asks for newlines as they are; `read_text` would have made them all alike.
        data = tomllib.loads(text.decode().replace("\r\n", "\n"))
    except RecursionError:
        raise DamagedError(f"{path}: nested too deeply; expected at most {MAX_NESTING} levels") from None
    except ValueError as error:  # Of tomllib, of UTF-8, or of int(), which takes 4,300 digits.
        raise DamagedError(f"{path}: not TOML ({error})") from error
    containers = _containers(data, where=str(path))
    _check_texts(containers, str(path))
    for container in containers:
        for value in _values(container):
            _check_number(value, str(path))
    return data


def _check_regular(path: Path, mode: int) -> None:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
    }
    if not stat.S_ISREG(mode):
        raise HyalineError(f"{path}: is {kinds.get(stat.S_IFMT(mode), 'no regular file')}; expected a file")


@contextlib.contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turns errors of the system into a HyalineError, except those that say nothing about the file."""
    try:
        yield
    except OSError as error:
        if error.errno in _OUT_OF_RESOURCES:
            raise
        if error.errno == errno.ENOENT:
            raise DamagedError(f"{path}: the file is missing") from error
        raise HyalineError(describe_os_error(error, path)) from error


def _integer(digits: str) -> int:
    if len(digits) > MAX_DIGITS or not -(2**63) <= (value := int(digits)) < 2**63:
        raise HyalineError(f"the number {shown(digits)} is too large; expected one of 64 bits")
    return value


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise HyalineError(f"the number {shown(text)} is not finite; expected one that is")
    return value


def _object(pairs: list[tuple[str, Json]]) -> dict[str, Json]:
    content = dict(pairs)
    if len(content) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))
        raise HyalineError(f"key {shown(twice)} stands twice in one object; expected each key once")
    return content


def _containers(data: object, *, where: str) -> list[dict | list]:
    """Every dict and list in `data`, itself among them; refuses nesting that recursion might not survive."""
    found: list[dict | list] = []
    level = [data]
    for _ in range(MAX_NESTING + 1):
        level = [value for value in level if type(value) is dict or type(value) is list]
        if not level:
            return found
        found += level
        level = [value for container in level for value in _values(container)]
    raise DamagedError(f"{where}: nested too deeply; expected at most {MAX_NESTING} levels")


def _values(container: dict | list) -> Iterable[object]:
    return container.values() if type(container) is dict else container


def _check_number(value: object, where: str) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise DamagedError(f"{where}: holds the number {value}; expected finite ones")
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise DamagedError(f"{where}: holds a number of {value.bit_length()} bits; expected at most 64")


def _check_texts(containers: list[dict | list], where: str) -> None:
    for container in containers:
        for value in (*container, *_values(container)):
            if isinstance(value, str):
                check_text(value, where)


def check_text(text: str, where: str) -> None:
    """Refuses what JSON could not hold or no terminal could show: a NUL, or half of a character."""
    if "\0" in text or any("\ud800" <= char <= "\udfff" for char in text):
        raise DamagedError(f"{where}: the string {shown(text)} holds a NUL or half of a character; expected text")
