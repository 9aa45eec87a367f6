"""HTML: markup that escapes every string, and pages that are one file with styles and scripts inside."""

import base64
import hashlib
import html
from collections.abc import Iterable, Sequence
from pathlib import Path

from datagen.disk.errors import printable

VOID = frozenset(
    {"br", "circle", "image", "img", "input", "line", "meta", "path", "polygon", "polyline", "rect", "use"}
)
"""HTML and SVG elements without content."""


class Markup(str):
    """Text that is HTML already; only `tag` and `join` make it."""

    __slots__ = ()


Part = str | int | float | None
"""Content of an element: markup is kept, other values are escaped, None is skipped."""


def tag(name: str, /, *parts: Part, **attributes: str | int | float | bool | None) -> Markup:
    """One element.

    Args:
        attributes: by name, with `_` for `-` and a trailing `_` after Python keywords; None and False omit one, True
            writes it without a value.
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
    """The parts, concatenated."""
    return Markup(
        "".join(part if isinstance(part, Markup) else escaped(str(part)) for part in parts if part is not None)
    )


def prose(text: str) -> Markup:
    """Text with code between backticks, as in messages for a terminal."""
    pieces = text.split("`")
    if len(pieces) % 2 == 0:  # A backtick without a partner.
        return join([text])
    return join(tag("code", piece) if place % 2 else piece for place, piece in enumerate(pieces))


def escaped(text: str) -> str:
    """Text escaped for elements and quoted attributes; control characters are spelled out."""
    return html.escape(printable(text), quote=True)


def document(title: str, *content: Part, navigation: Part = None) -> bytes:
    """The bytes of a page.

    Its content security policy allows only embedded pictures and the page's own script, so that nothing smuggled in
    through a hostile name runs.
    """
    style, script = (Path(__file__).with_name(name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    if "</" in style or "</script" in script:
        raise ValueError("a style or script contains an end tag, which would end it inside the page")
    policy = (
        f"default-src 'none'; img-src data:; style-src {_source(style)}; script-src {_source(script)}; "
        "base-uri 'none'; form-action 'none'"
    )
    head = [
        tag("meta", charset="utf-8"),
        # `tag` would escape the policy's quotes: the same to browsers, but hard to read.
        Markup(f'<meta http-equiv="Content-Security-Policy" content="{policy}"/>'),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("title", title),
        Markup(f"<style>{style}</style>"),
    ]
    skip = tag("a", "Skip to the content", href="#content", class_="skip")
    main = tag("main", *content, id="content")
    body = tag("body", skip, navigation, main, Markup(f"<script>{script}</script>"))
    lines = ["<!DOCTYPE html>", '<html lang="en">', "<head>", *head, "</head>", body, "</html>", ""]
    return "\n".join(lines).encode()


def anchor(*words: str) -> str:
    """An id for a place in a page, unique to these words."""
    digest = hashlib.sha256("\0".join(words).encode()).hexdigest()[:12]
    return f"p{digest}"


def section(title: str, *parts: Part, id_: str, level: int = 2) -> Markup:
    """A section with its heading, which also labels it for screen readers."""
    heading = f"{id_}-title"
    return tag("section", tag(f"h{level}", title, id=heading), *parts, id=id_, aria_labelledby=heading)


def definitions(pairs: Sequence[tuple[str, Part]]) -> Markup:
    """Terms and their descriptions, as a list of two columns."""
    return tag("dl", *(join([tag("dt", term), tag("dd", value)]) for term, value in pairs))


def _source(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
