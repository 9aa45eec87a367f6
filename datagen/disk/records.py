"""Frozen records and the JSON that they become: read strictly, sealed on disk, and checked where they are made.

Whatever a file holds, reading it either gives plain values or raises one HyalineError that names the file. Records
become JSON and come back by the types of their fields. `checked` does the same for what a caller gives.
"""

import dataclasses
import functools
import hashlib
import inspect
import json
import math
import re
import sys
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from datagen.disk.errors import DamagedError, HyalineError, as_hyaline_error, shown
from datagen.disk.storage import commit, read_regular

if typing.TYPE_CHECKING:
    Json = typing.Union[None, bool, int, float, str, list["Json"], dict[str, "Json"]]  # noqa: UP007
else:
    Json = None | bool | int | float | str | list | dict  # What checks annotations at run time takes no recursion.
T = typing.TypeVar("T")
Value = typing.TypeVar("Value")
Entry = typing.TypeVar("Entry", bound=Callable[..., typing.Any])

MAX_JSON_BYTES = 16 << 20
"""The largest that is written here holds the cameras of 10,000 views."""
MAX_NESTING = 64
SEAL = "sha256"
"""Key under which a sealed JSON file holds the SHA-256 of everything else in it."""


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
    if (tolist := getattr(value, "tolist", None)) is not None:  # Numbers and arrays of NumPy, whose float64 is a float.
        return to_json(tolist())
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Path):
        return value.as_posix()
    raise TypeError(f"{value!r}: a {type(value).__name__} has no JSON form here")


def from_json(kind: type[T], data: Json, *, where: str) -> T:
    """The record of class `kind` that `data` describes; the inverse of `to_json`.

    Errors name the place of an unknown or missing key, or of a value of the wrong type.
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
        return {key: _parse(arguments[1], item, f"{where}[{key[:80]!r}]") for key, item in entries.items()}
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
    """The value of a key that has to be there."""
    if key not in data:
        raise HyalineError(f"{where}: key {key!r} is missing; build it again")
    return data[key]


# Files


def load_json(path: Path) -> dict[str, Json]:
    """A JSON object from a file.

    Raises:
        HyalineError: missing, not UTF-8 JSON, not an object, nested too deeply, or a number beyond 64 bits.
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


def _check(value: object, levels: int) -> None:
    """Refuses nesting that recursion might not survive, and integers that NumPy could not hold."""
    if isinstance(value, (dict, list)):
        if levels == 0:
            raise RecursionError
        for item in value.values() if isinstance(value, dict) else value:
            _check(item, levels - 1)
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise HyalineError(f"the number {shown(value)} does not fit into 64 bits")


# Sealed files


def dump_json(data: Json) -> bytes:
    """Canonical bytes: sorted keys, two spaces, a final newline; NaN and infinity are refused."""
    return (json.dumps(data, indent=2, sort_keys=True, allow_nan=False) + "\n").encode()


def seal_of(data: dict[str, Json]) -> str:
    """The hash under which `seal_bytes` seals `data`."""
    return hashlib.sha256(dump_json(data)).hexdigest()


def seal_bytes(data: dict[str, Json]) -> bytes:
    """The bytes of a sealed JSON file: canonical, with the hash of the rest under `SEAL`."""
    if SEAL in data:
        raise ValueError(f"the key {SEAL!r} is reserved")
    return dump_json({**data, SEAL: seal_of(data)})


def commit_sealed(path: Path, data: dict[str, Json]) -> None:
    """Commits `data` as a sealed JSON file."""
    commit(path, seal_bytes(data))


def load_sealed(path: Path) -> dict[str, Json]:
    """The content of a sealed JSON file, without its seal; a DamagedError if any byte differs from what was sealed."""
    if path.is_symlink():
        raise DamagedError(f"{path}: is a link; expected the file itself")
    text = read_regular(path, at_most=MAX_JSON_BYTES)
    data = parse_json(text, where=str(path))
    data.pop(SEAL, None)
    if text != seal_bytes(data):
        raise DamagedError(f"{path}: does not match its own checksum, was damaged or edited; restore or remake it")
    return data


# What callers give


def checked(function: Entry) -> Entry:
    """Makes a function, or a record, raise a HyalineError for whatever is wrong in a call.

    Arguments must match their annotations, and numbers outside of arrays must be finite. Numbers and arrays of NumPy,
    and lists, may replace numbers and tuples.
    """
    if isinstance(function, type):
        function.__init__ = checked(function.__init__)
        return typing.cast(Entry, function)
    where = function.__qualname__.removesuffix(".__init__")
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: typing.Any, **kwargs: typing.Any) -> typing.Any:
        try:
            given = signature.bind(*args, **kwargs)
        except TypeError as error:
            names = ", ".join(name for name in signature.parameters if name != "self")
            raise HyalineError(f"{where}: {error}; expected {names}") from None
        for name, value in given.arguments.items():
            parameter = signature.parameters[name]
            if parameter.kind is not parameter.VAR_KEYWORD:
                given.arguments[name] = _fitted(value, parameter.annotation, f"{where}: {name}")
        try:
            return function(*given.args, **given.kwargs)
        except (OSError, MemoryError, RuntimeError) as error:
            if (told := as_hyaline_error(error)) is None:
                raise
            raise told from error

    return typing.cast(Entry, call)


def _fitted(value: object, kind: typing.Any, where: str) -> object:
    """The value, or the same in Python's own types, whichever is of a kind."""
    if isinstance(kind, str) or kind is inspect.Parameter.empty:
        return value  # `self`, or a name that only type checkers import.
    found, is_one = value, _is_of(value, kind)
    if not is_one:  # Only then: it takes seconds to convert an array of many points.
        found = in_python(value)
        is_one = _is_of(found, kind)
    if not is_one or not _is_finite(found):
        expected = "finite numbers" if is_one else _words(kind)
        raise HyalineError(f"{where}: is {' '.join(shown(value).split())}; expected {expected}")
    return found


def _is_of(value: object, kind: typing.Any) -> bool:
    import typeguard  # Not before: the two take 60 ms, and the other brings NumPy.
    from jaxtyping import jaxtyped

    try:
        with jaxtyped("context"):  # Axes that a caller has named mean nothing here.
            typeguard.check_type(value, kind, collection_check_strategy=typeguard.CollectionCheckStrategy.ALL_ITEMS)
    except typeguard.TypeCheckError:
        return False
    return True


def in_python(value: typing.Any) -> object:
    numpy = sys.modules.get("numpy")  # Help is printed without it.
    if numpy and isinstance(value, (numpy.ndarray, numpy.generic)):
        value = value.tolist()
    return tuple(map(in_python, value)) if isinstance(value, (list, tuple)) else value


def _is_finite(value: object) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def _words(kind: typing.Any) -> str:
    """An annotation without the names of modules, such as `Path | str | None`."""
    short = re.sub(r"\b(?:\w+\.)+(?=[A-Za-z])", "", inspect.formatannotation(kind))
    return re.sub(r"Literal\[(.*?)\]", r"\1", short)
