"""HTML: markup that escapes every string, pages that are one file with styles and scripts inside, pictures in them."""

import base64
import hashlib
import html
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

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
        GENERATOR,
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


GENERATOR = tag("meta", name="generator", content="hyaline")
"""What a file that `document` made begins with, after at most 100 bytes."""


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


# Pictures: each is stored once and shown wherever it is needed, also over another one


Image8 = UInt8[np.ndarray, "h w c"] | UInt8[np.ndarray, "h w"]
SHARP_BELOW = 256
"""Pictures with fewer pixels along their longer side are enlarged without smoothing."""


def panel(caption: str, *pictures: Markup, button: str = "") -> Markup:
    """Pictures of a row below their caption.

    Args:
        button: what shows them alone; the caption unless given.
    """
    return tag("figure", tag("figcaption", caption), *pictures, data_name=button or caption)


def row(*panels: Part, label: str) -> Markup:
    """A view's pictures side by side; scripts add a button for each, and a slider between a truth and a prediction.

    Args:
        label: what screen readers say.
    """
    return tag("div", tag("div", *panels, class_="row", role="group", aria_label=label, tabindex=0), class_="view")


class Gallery:
    """The pictures of a page, up to a number of bytes.

    Once one picture does not fit, no later one is stored: pictures stored first take precedence.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most = most_bytes
        self._stored: dict[str, Markup] = {}
        self._sizes: dict[str, tuple[int, int]] = {}
        """Width and height of the stored pictures, by name."""
        self._without_room: set[str] = set()
        self.used = 0
        """Total size of the stored data URIs, in bytes."""

    @property
    def left_out(self) -> int:
        """Number of pictures that did not fit."""
        return len(self._without_room)

    def add(self, name: str, read: Callable[[], Image8]) -> bool:
        """Stores a picture under a name; returns False if it does not fit. A name stored before keeps its picture.

        Args:
            read: returns the picture; called only while there is room.
        """
        if name in self._stored:
            return True
        if not self._without_room:
            image = read()
            address, height, width = lossless_uri(image), *image.shape[:2]
            if self.used + len(address) <= self._most:
                self.used += len(address)
                self._stored[name] = tag("image", id=name, width=width, height=height, href=address)
                self._sizes[name] = width, height
                return True
        self._without_room.add(name)
        return False

    def show(self, *names: str, label: str, class_: str = "") -> Markup:
        """Stored pictures of one size on top of each other; all but the first have the class `over`."""
        uses = [tag("use", href=f"#{name}", class_="over" if place else None) for place, name in enumerate(names)]
        width, height = self._sizes[names[0]]
        texels = " sharp" if max(width, height) < SHARP_BELOW else ""
        return tag(
            "svg",
            *uses,
            class_=f"picture {class_}".strip() + texels,
            viewBox=f"0 0 {width} {height}",
            role="img",
            aria_label=label,
        )

    def figure(
        self, name: str, read: Callable[[], Image8], *, label: str, caption: str = "", button: str = ""
    ) -> Markup | None:
        """Stores a picture and shows it as a panel; None if it does not fit.

        Args:
            label: what screen readers say, and the caption unless that is given.
        """
        return panel(caption or label, self.show(name, label=label), button=button) if self.add(name, read) else None

    def store(self) -> Markup:
        """The hidden element that contains all pictures; put it into the page once."""
        return tag("svg", tag("defs", *self._stored.values()), class_="store", aria_hidden="true", width=0, height=0)


def lossless_uri(image: Image8) -> str:
    """A picture as a lossless data URI, a fifth smaller than a PNG."""
    return data_uri(image, "webp", lossless=True, quality=50, method=3, exact=True)


def data_uri(image: Image8, kind: str, **how: int) -> str:
    """A picture as a data URI, encoded by Pillow as this kind of file with these settings."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format=kind, **how)
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"
