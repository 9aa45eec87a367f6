"""What enters the library: arguments of its public functions and fields of its records, checked by their annotations.

Errors of the system that such a call raises become a `HyalineError`, too.
"""

import functools
import inspect
import math
import re
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from jaxtyping import jaxtyped

from datagen.disk.errors import HyalineError, as_hyaline_error
from datagen.disk.records import shown

Entry = TypeVar("Entry", bound=Callable[..., Any])


def checked(entry: Entry) -> Entry:
    """Makes a function, or a record, raise a HyalineError for whatever is wrong in a call.

    Arguments must match their annotations, and numbers outside of arrays must be finite. Numbers and arrays of NumPy,
    and lists, may replace numbers and tuples.
    """
    if isinstance(entry, type):
        entry.__init__ = checked(entry.__init__)
        return cast(Entry, entry)
    where = entry.__qualname__.removesuffix(".__init__")
    signature = inspect.signature(entry)

    @functools.wraps(entry)
    def call(*args: Any, **kwargs: Any) -> Any:
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
            return entry(*given.args, **given.kwargs)
        except (OSError, MemoryError, RuntimeError) as error:
            if (told := as_hyaline_error(error)) is None:
                raise
            raise told from error

    return cast(Entry, call)


def _fitted(value: object, kind: Any, where: str) -> object:
    """The value, or the same in Python's own types, whichever is of a kind."""
    if isinstance(kind, str) or kind is inspect.Parameter.empty:
        return value  # `self`, or a name that only type checkers import.
    found = next((one for one in (value, _in_python(value)) if _is_of(one, kind)), _NOT_ONE)
    if found is _NOT_ONE or not _is_finite(found):
        expected = "finite numbers" if found is not _NOT_ONE else _words(kind)
        raise HyalineError(f"{where}: is {' '.join(shown(value).split())}; expected {expected}")
    return found


_NOT_ONE = object()


def _is_of(value: object, kind: Any) -> bool:
    import typeguard  # Not before: that takes 60 ms.

    try:
        with jaxtyped("context"):  # Axes that a caller has named mean nothing here.
            typeguard.check_type(value, kind, collection_check_strategy=typeguard.CollectionCheckStrategy.ALL_ITEMS)
    except typeguard.TypeCheckError:
        return False
    return True


def _in_python(value: object) -> object:
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    return tuple(map(_in_python, value)) if isinstance(value, (list, tuple)) else value


def _is_finite(value: object) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def _words(kind: Any) -> str:
    """An annotation without the names of modules, such as `Path | str | None`."""
    short = re.sub(r"\b(?:\w+\.)+(?=[A-Za-z])", "", inspect.formatannotation(kind))
    return re.sub(r"Literal\[(.*?)\]", r"\1", short)
