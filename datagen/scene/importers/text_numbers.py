"""Numbers in text files that anybody may have written."""

import math

from datagen.disk.errors import HyalineError
from datagen.disk.records import shown


def floats(words: list[str], count: int, *, where: str) -> tuple[float, ...]:
    """The first `count` words as finite numbers.

    Raises:
        HyalineError: there are fewer, or one is no finite number.
    """
    try:
        values = tuple(map(float, words[:count]))
    except ValueError:
        values = ()
    if len(values) < count or not all(map(math.isfinite, values)):
        raise HyalineError(f"{where}: is {shown(' '.join(words))}; expected {count} finite numbers")
    return values


def lines_of(data: bytes, *, where: str) -> list[str]:
    """The lines of a text in UTF-8 or Latin-1; those that end in a backslash go on in the next.

    Raises:
        HyalineError: it holds bytes that no text has.
    """
    if b"\0" in data:
        raise HyalineError(f"{where}: holds zero bytes; expected text")
    try:
        text = data.decode()
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines()
