"""How frozen records become JSON and come back: strict, typed, without surprises."""

import dataclasses
import reprlib
import sys
import types
import typing
from collections.abc import Mapping
from pathlib import Path

from datagen.disk.errors import HyalineError

if typing.TYPE_CHECKING:
    Json = typing.Union[None, bool, int, float, str, list["Json"], dict[str, "Json"]]  # noqa: UP007
else:
    Json = None | bool | int | float | str | list | dict  # What checks annotations at run time takes no recursion.
T = typing.TypeVar("T")
Value = typing.TypeVar("Value")

MAX_ITEMS = 10_000
"""Of a list in a record: what asks for more would only keep somebody waiting for its refusal."""

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
        # Private records describe a file's layout; they stand in no union and need no tag.
        return fields if name.startswith("_") else {"type": name, **fields}
    if isinstance(value, (tuple, list)):
        return [to_json(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Path):
        return value.as_posix()
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
    return kind(**values)


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
