"""How the fields of a configuration record become flags of a command, and suffixes of a run's folder."""

import dataclasses
import math
import typing
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, from_json
from datagen.terminal.parsing import changed_fields

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

RecordT = TypeVar("RecordT", bound="DataclassInstance")

Limits = tuple[float, float]
"""Least and largest value of a number; infinity if it has no upper limit."""

COUNT: Limits = (1, math.inf)
AMOUNT: Limits = (0, math.inf)
SHARE: Limits = (0, 1)
SEED: Limits = (0, 2**32 - 1)


def choice(
    default: Any,
    suffix: str | dict[object, str] = "",
    *,
    flag: str = "",
    limits: Limits | None = None,
) -> Any:
    """A field of a record that is a flag.

    Args:
        suffix: what marks a run's folder where the value is not the usual one: a template, or one for each value (and
            under the empty one that of all others); empty: nothing does, since no result depends on it.
        flag: its name on the command line, without dashes; default: the field's.
        limits: of its number, which `check_limits` checks.
    """
    about = {"suffix": suffix, "flag": flag, "limits": limits}
    return dataclasses.field(default=default, metadata=about)


def unflagged(default: Any, *, limits: Limits | None = None) -> Any:
    """A field without a flag: the method's defaults set it, or the dataset."""
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
    for item, value in changed_fields(record, usual):
        suffix = item.metadata.get("suffix", f"{item.name.replace('_', '-')}{{}}")
        template = suffix.get(value) or suffix[""] if isinstance(suffix, dict) else suffix
        words += [template.format(value)] if template else []
    return words
