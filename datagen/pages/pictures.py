"""Pictures embedded in a page: each is stored once and shown wherever it is needed, also over another one."""

import base64
import io
from collections.abc import Callable

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from datagen.pages.html import Markup, tag

Image8 = UInt8[np.ndarray, "h w c"] | UInt8[np.ndarray, "h w"]


class Gallery:
    """The pictures of a page, up to a number of bytes.

    Once one picture does not fit, no later one is stored: pictures stored first take precedence.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most = most_bytes
        self._encoded: dict[str, tuple[str, int, int]] = {}
        """Data URIs of pictures with their width and height, by name."""
        self._stored: dict[str, Markup] = {}
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
            if name not in self._encoded:
                image = read()
                self._encoded[name] = lossless_uri(image), image.shape[1], image.shape[0]
            address, width, height = self._encoded[name]
            if self.used + len(address) <= self._most:
                self.used += len(address)
                self._stored[name] = tag("image", id=name, width=width, height=height, href=address)
                return True
        self._without_room.add(name)
        return False

    def show(self, *names: str, label: str, class_: str = "") -> Markup:
        """Stored pictures of one size on top of each other; all but the first have the class `over`."""
        _, width, height = self._encoded[names[0]]
        uses = [tag("use", href=f"#{name}", class_="over" if place else None) for place, name in enumerate(names)]
        return tag(
            "svg",
            *uses,
            class_=f"picture {class_}".strip(),
            viewBox=f"0 0 {width} {height}",
            role="img",
            aria_label=label,
        )

    def figure(self, name: str, read: Callable[[], Image8], *, label: str, caption: str) -> Markup | None:
        """Stores a picture and shows it with a caption; None if it does not fit.

        Args:
            label: what screen readers say.
        """
        if not self.add(name, read):
            return None
        return tag("figure", self.show(name, label=label), tag("figcaption", caption), data_name=caption)

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
