"""Markup that cannot be broken by what it shows: every string is escaped unless it is markup already."""

import html
from collections.abc import Iterable

from datagen.disk.names import printable

VOID = frozenset(
    {"br", "circle", "image", "img", "input", "line", "meta", "path", "polygon", "polyline", "rect", "use"}
)
"""Elements that hold nothing, of HTML and SVG."""


class Markup(str):
    """Text that is HTML already, made by `tag` and `join` alone."""

    __slots__ = ()


Part = str | int | float | None
"""What may stand inside an element: markup as it is, other values escaped, None not at all."""


def tag(name: str, /, *parts: Part, **attributes: str | int | float | bool | None) -> Markup:
    """One element.

    Args:
        attributes: by name, with `_` for `-` and a trailing `_` where the name is a word of Python; None and False
            leave one out, True gives it no value.
    """
    written = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        attribute = key.rstrip("_").replace("_", "-")
        written.append(attribute if value is True else f'{attribute}="{escaped(str(value))}"')
    opening = " ".join(written)
    if name in VOID:
        # A slash closes elements of SVG; HTML ignores it.
        return Markup(f"<{opening}/>")
    return Markup(f"<{opening}>{join(parts)}</{name}>")


def join(parts: Iterable[Part]) -> Markup:
    """Parts one after the other."""
    return Markup(
        "".join(part if isinstance(part, Markup) else escaped(str(part)) for part in parts if part is not None)
    )


def prose(text: str) -> Markup:
    """Text in which what stands between backticks is code, as in messages for a terminal."""
    pieces = text.split("`")
    if len(pieces) % 2 == 0:  # One is left over.
        return join([text])
    return join(tag("code", piece) if place % 2 else piece for place, piece in enumerate(pieces))


def escaped(text: str) -> str:
    """Text that neither an element nor a quoted attribute takes for markup; control characters are spelled out."""
    return html.escape(printable(text), quote=True)
