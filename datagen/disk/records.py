"""JSON and TOML files that anybody may have written, and the frozen records that they describe.

Whatever a file holds, reading it either gives plain values or raises one HyalineError that names the file. Records
become JSON and come back strictly, by the types of their fields.
"""

import contextlib
import dataclasses
import errno
import json
import os
import reprlib
import stat
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import msgspec

from datagen.disk.errors import DamagedError, HyalineError, describe_os_error

if typing.TYPE_CHECKING:
    Json = typing.Union[None, bool, int, float, str, list["Json"], dict[str, "Json"]]  # noqa: UP007
else:
    Json = None | bool | int | float | str | list | dict  # What checks annotations at run time takes no recursion.
T = typing.TypeVar("T")
Value = typing.TypeVar("Value")

MAX_JSON_BYTES = 16 << 20
"""The largest that is written here holds the cameras of 10,000 views."""
MAX_TOML_BYTES = 1 << 16
MAX_NESTING = 64

_OUT_OF_RESOURCES = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EINTR)
"""Errors of the machine, not of the file: they are no reason to call it damaged and to make it again."""

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


def _parse(kind: typing.Any, data: typing.Any, where: str) -> object:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _parse(_alternative(arguments, data, where), data, where)
    if origin is tuple:
        values = _converted(list, data, where, "a list")
        kinds = [arguments[0]] * len(values) if arguments[-1] is Ellipsis else arguments
        if len(kinds) != len(values):
            raise HyalineError(f"{where}: is {shown(data)}; expected a list of {len(kinds)}")
        return tuple(_parse(one, item, f"{where}[{i}]") for i, (one, item) in enumerate(zip(kinds, values)))
    if origin is dict:
        entries = _converted(dict, data, where, "an object")
        return {key: _parse(arguments[1], item, f"{where}[{shown(key)}]") for key, item in entries.items()}
    if dataclasses.is_dataclass(kind):
        return _parse_record(typing.cast(type, kind), _converted(dict, data, where, "an object"), where)
    if origin is typing.Literal:
        return _converted(kind, data, where, f"one of {', '.join(map(repr, arguments))}")
    return _converted(kind, data, where, _EXPECTED[kind])


_EXPECTED: dict[object, str] = {
    float: "a finite number",
    int: "an integer of 64 bits",
    bool: "true or false",
    str: "text",
    types.NoneType: "null",
}


def _converted(kind: typing.Any, data: typing.Any, where: str, expected: str) -> typing.Any:
    """A value without records in it, of the same type in JSON and here: 1 is no `true`."""
    try:
        return msgspec.convert(data, _INT64 if kind is int else kind)
    except msgspec.ValidationError:
        raise HyalineError(f"{where}: is {shown(data)}; expected {expected}") from None


_INT64 = typing.Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]


def _alternative(kinds: tuple[typing.Any, ...], data: Json, where: str) -> object:
    """The kind of a union that a value has to be: a record by its `type`, anything else by what it looks like."""
    records = {kind.__name__: kind for kind in kinds if isinstance(kind, type) and dataclasses.is_dataclass(kind)}
    if isinstance(data, dict) and records:
        name = data.get("type")
        if not isinstance(name, str) or name not in records:
            raise HyalineError(f"{where}.type: is {shown(name)}; expected one of {sorted(records)}")
        return records[name]
    plain = [kind for kind in kinds if kind not in records.values()]
    if types.NoneType in plain and (data is None or len(plain) > 1):
        if data is None:
            return types.NoneType
        plain.remove(types.NoneType)
    if str in plain and len(plain) == 2:  # Text, or what is none.
        plain = [kind for kind in plain if (kind is str) == isinstance(data, str)]
    if len(plain) != 1 or plain[0] is types.NoneType:
        raise HyalineError(f"{where}: {shown(data)} has no `type`; expected one of {sorted(records)}")
    return plain[0]


def _parse_record(kind: type, entries: dict[str, Json], where: str) -> object:
    hints = typing.get_type_hints(kind)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    tag = entries.get("type", kind.__name__)
    if "type" not in fields and tag != kind.__name__:
        raise HyalineError(f"{where}.type: is {shown(tag)}; expected {kind.__name__!r}, or no such key")
    if unknown := sorted(set(entries) - set(fields) - {"type"}):
        raise HyalineError(f"{where}: unknown key {shown(unknown[0])}; known are {', '.join(sorted(fields))}")
    missing = dataclasses.MISSING
    required = {name for name, field in fields.items() if field.default is field.default_factory is missing}
    if absent := sorted(required - set(entries)):
        raise HyalineError(f"{where}: key {absent[0]!r} is missing; expected {', '.join(sorted(required))}")
    values = {name: _parse(hints[name], entries[name], f"{where}.{name}") for name in fields if name in entries}
    try:
        return kind(**values)
    except HyalineError as error:  # A record names its field, not where it was read.
        raise HyalineError(f"{where}: {error}") from None


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
            if not stat.S_ISREG(path.stat().st_mode):
                raise HyalineError(f"{path}: is a folder, a pipe or a device; expected a file")
            return path.open("rb")
    except ValueError as error:  # A NUL, or half of a surrogate pair.
        raise HyalineError(f"{shown(str(path))}: cannot be the path of a file ({error})") from error


def read_regular(path: Path, *, at_most: int | None = None) -> bytes:
    """The bytes of a regular file.

    Raises:
        HyalineError: see `open_regular`; or it holds more than `at_most` bytes.
    """
    with open_regular(path) as file, _refusing(path):
        size = os.fstat(file.fileno()).st_size
        if at_most is not None and size > at_most:
            raise HyalineError(f"{path}: holds {size:,} bytes; expected at most {at_most:,}")
        return file.read()


def load_json(path: Path) -> dict[str, Json]:
    """A JSON object from a file.

    Raises:
        HyalineError: missing, not UTF-8 JSON, not an object, nested too deeply, or a number that is not finite or does
            not fit into 64 bits.
    """
    return parse_json(read_regular(path, at_most=MAX_JSON_BYTES), where=str(path))


def parse_json(text: bytes, *, where: str) -> dict[str, Json]:
    """A JSON object from the bytes of a file; see `load_json`."""
    try:
        data = msgspec.json.decode(text)
        _check(data, MAX_NESTING)
    except (UnicodeDecodeError, msgspec.DecodeError, HyalineError) as error:
        raise DamagedError(f"{where}: not a JSON file ({error})") from error
    except RecursionError:
        raise DamagedError(f"{where}: nested too deeply; expected at most {MAX_NESTING} levels") from None
    if not isinstance(data, dict):
        raise DamagedError(f"{where}: holds a {type(data).__name__}; expected a JSON object")
    return data


def load_toml(path: Path) -> dict[str, Json]:
    """The content of a TOML file; what is said of `load_json` holds for it, too.

    Raises:
        HyalineError: see there.
    """
    text = read_regular(path, at_most=MAX_TOML_BYTES)
    try:
        plain = json.dumps(tomllib.loads(text.decode().replace("\r\n", "\n")))
    except (ValueError, TypeError) as error:  # Of tomllib or UTF-8; or a date, which is no value here.
        raise DamagedError(f"{path}: not TOML ({error})") from error
    except RecursionError:
        raise DamagedError(f"{path}: nested too deeply; expected at most {MAX_NESTING} levels") from None
    return parse_json(plain.encode(), where=str(path))


def _check(value: object, levels: int) -> None:
    """Refuses nesting that recursion might not survive, and integers that NumPy could not hold."""
    if isinstance(value, (dict, list)):
        if levels == 0:
            raise RecursionError
        for item in value.values() if isinstance(value, dict) else value:
            _check(item, levels - 1)
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise HyalineError(f"the number {shown(value)} does not fit into 64 bits")


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
