"""Untrusted JSON as typed records, by msgspec."""

import re
from typing import TypeVar

from msgspec import ValidationError, convert

from datagen.disk.errors import HyalineError

T = TypeVar("T")


def read(kind: type[T], data: object, *, where: str) -> T:
    """The record that JSON describes.

    Raises:
        HyalineError: a value is missing or of the wrong type, named by its place.
    """
    try:
        return convert(data, kind, strict=False)  # Exporters write 3.0 for a count of 3.
    except ValidationError as error:
        what, _, place = str(error).partition(" - at `$")
        inside = re.sub(r"^\.|`$", "", place)
        raise HyalineError(f"{where}{f': {inside}' if inside else ''}: {what}; export the file again") from None
