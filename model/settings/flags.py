"""How the fields of a configuration record become flags of a command, and suffixes of a run's folder."""

import dataclasses
import functools
import math
import typing
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, from_json

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

RecordT = TypeVar("RecordT", bound="DataclassInstance")

Limits = tuple[float, float]
"""The least and the largest value of a number; infinity where there is no largest."""

COUNT: Limits = (1, math.inf)
AMOUNT: Limits = (0, math.inf)
SHARE: Limits = (0, 1)
SEED: Limits = (0, 2**32 - 1)


def choice(
    default: Any,
    suffix: str | dict[object, str] = "",
    *,
    flag: str = "",
    is_preset: bool = False,
    limits: Limits | None = None,
) -> Any:
    """A field of a record that is a flag.

    Args:
        suffix: what marks a run's folder where the value is not the usual one: a template, or one for each value (and
            under the empty one that of all others); empty: nothing does, since no result depends on it.
        flag: its name on the command line, without dashes; default: the field's.
        is_preset: it decides what is usual for other fields, so it marks the folder where it is not its own default.
        limits: of its number, which `check_limits` checks.
    """
    about = {"suffix": suffix, "flag": flag, "is_preset": is_preset, "limits": limits}
    return dataclasses.field(default=default, metadata=about)


def unflagged(default: Any, *, limits: Limits | None = None) -> Any:
    """A field that is no flag: presets set it, or the dataset."""
    return dataclasses.field(default=default, metadata={"is_hidden": True, "limits": limits})


def check_limits(record: object) -> None:
    """Check the numbers of a record against the limits of their fields; None is within any.

    Raises:
        HyalineError: a number that is not a number, too small or too large.
    """
    for item in dataclasses.fields(record):  # pyright: ignore[reportArgumentType]
        value, limits = getattr(record, item.name), item.metadata.get("limits")
        if limits is None or value is None or (limits[0] <= value <= limits[1] and value < math.inf):
            continue
        wanted = f"{limits[0]} to {limits[1]}" if limits[1] < math.inf else f"at least {limits[0]}"
        raise HyalineError(f"{item.name}: is {value}; expected {wanted}")


def flags_of(record: type) -> dict[str, str]:
    """The field behind each flag that a record makes, records in it included; flags without dashes in front."""
    names: dict[str, str] = {}
    for item in dataclasses.fields(record):
        inner = _record_in(item)
        if inner is not None:
            names |= flags_of(inner)
        elif not item.metadata.get("is_hidden"):
            names[item.metadata.get("flag") or item.name.replace("_", "-")] = item.name
    return names


def settings_of(record: object) -> dict[str, Any]:
    """The value behind each flag of a record, by the flag's name in Python: `texture_size` for --texture-size."""
    values: dict[str, Any] = {}
    for item in dataclasses.fields(record):  # pyright: ignore[reportArgumentType]
        value = getattr(record, item.name)
        if dataclasses.is_dataclass(value):
            values |= settings_of(value)
        elif not item.metadata.get("is_hidden"):
            values[_python_name(item)] = value
    return values


def presets_of(record: type) -> set[str]:
    """The flags of a record that decide what is usual for others, by their names in Python."""
    return {_python_name(item) for item in dataclasses.fields(record) if item.metadata.get("is_preset")}


def with_settings(record: RecordT, settings: Mapping[str, object]) -> RecordT:
    """The record with the values of some of its flags changed; names of flags that it does not have are left alone."""
    kinds, changed = typing.get_type_hints(type(record)), {}
    for item in dataclasses.fields(record):
        value = getattr(record, item.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            changed[item.name] = with_settings(value, settings)
        elif not item.metadata.get("is_hidden") and (name := _python_name(item)) in settings:
            changed[item.name] = from_json(kinds[item.name], typing.cast(Json, settings[name]), where=name)
    return dataclasses.replace(record, **changed)


def _python_name(item: dataclasses.Field[Any]) -> str:
    return item.metadata.get("flag", "").replace("-", "_") or item.name


def suffixes(record: object, usual: object) -> list[str]:
    """What marks the folder of a run: a word for each field that is not as usual, in the fields' order."""
    words = []
    for item in dataclasses.fields(record):  # pyright: ignore[reportArgumentType]
        value, expected = getattr(record, item.name), getattr(usual, item.name)
        if _record_in(item) is not None:
            words += suffixes(value, expected)
            continue
        suffix = item.metadata.get("suffix", f"{item.name.replace('_', '-')}{{}}")
        is_preset = item.metadata.get("is_preset")
        if suffix and not item.metadata.get("is_hidden") and value != (item.default if is_preset else expected):
            template = suffix.get(value) or suffix[""] if isinstance(suffix, dict) else suffix
            words.append(template.format(value))
    return words


def words_of(record: object, usual: object) -> list[str]:
    """The words on a command line that ask for a record: a flag for each field of `usual` that is not as there."""
    words: list[str] = []
    for item in dataclasses.fields(usual):  # pyright: ignore[reportArgumentType]
        value, expected = getattr(record, item.name), getattr(usual, item.name)
        if _record_in(item) is not None:
            words += words_of(value, expected)
        elif not item.metadata.get("is_hidden") and value != (
            item.default if item.metadata.get("is_preset") else expected
        ):
            flag = f"--{item.metadata.get('flag') or item.name.replace('_', '-')}"
            words += [flag] if value is True and item.default is False else [flag, str(value)]
    return words


@functools.cache
def name_flags(record: type) -> None:
    """Tells tyro the flags of a record: names, help from the docstrings below its fields, and which fields are none.

    tyro 1.0.17 would keep a docstring's line breaks, because the lines after the first begin with blanks.
    """
    import docstring_parser
    import tyro

    documented = [base for base in reversed(record.__mro__) if dataclasses.is_dataclass(base)]
    texts = {
        param.arg_name: param.description
        for base in documented
        for param in docstring_parser.parse_from_object(base).params
    }
    annotations = {name: kind for base in documented for name, kind in base.__dict__.get("__annotations__", {}).items()}
    record.__annotations__ = dict(record.__dict__.get("__annotations__", {}))
    for item in dataclasses.fields(record):
        inner, kind = _record_in(item), annotations[item.name]
        if inner is not None:
            name_flags(inner)
        elif item.metadata.get("is_hidden"):
            record.__annotations__[item.name] = tyro.conf.Suppress[kind]
        else:
            text, name = " ".join((texts.get(item.name) or "").split()), item.metadata.get("flag") or None
            from typing import Annotated

            record.__annotations__[item.name] = Annotated[kind, tyro.conf.arg(name=name, help=text)]


def _record_in(item: dataclasses.Field[Any]) -> type | None:
    return item.type if isinstance(item.type, type) and dataclasses.is_dataclass(item.type) else None
