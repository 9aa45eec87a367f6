"""Pictures inside a page: each is stored once and shown wherever it is needed, also laid over another."""

import base64
import io
from collections.abc import Callable

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from datagen.pages.html import Markup, tag

Image8 = UInt8[np.ndarray, "h w c"] | UInt8[np.ndarray, "h w"]

Encoded = dict[str, tuple[str, int, int]]
"""Addresses that hold a picture, with its width and height, by name."""


class Gallery:
    """The pictures of a page, which are kept below a number of bytes.

    As soon as one finds no room, no other does: what is stored first comes before what is stored later.
    """

    def __init__(self, most_bytes: int, encoded: Encoded | None = None) -> None:
        """
        Args:
            encoded: pictures that another gallery has encoded; this one adds its own.
        """
        self._most = most_bytes
        self._encoded: Encoded = {} if encoded is None else encoded
        self._stored: dict[str, Markup] = {}
        self._without_room: set[str] = set()
        self.used = 0
        """Bytes of all pictures together, as text."""

    @property
    def left_out(self) -> int:
        """Pictures for which no room was left."""
        return len(self._without_room)

    def add(self, name: str, read: Callable[[], Image8]) -> bool:
        """Stores a picture under a name; False where there is no room for it. One that is there already stays.

        Args:
            read: gives the picture; asked only where it may find room.
        """
        if name in self._stored:
            return True
        if not self._without_room:
            if name not in self._encoded:
                image = read()
                self._encoded[name] = data_uri(image), image.shape[1], image.shape[0]
            address, width, height = self._encoded[name]
            if self.used + len(address) <= self._most:
                self.used += len(address)
                self._stored[name] = tag("image", id=name, width=width, height=height, href=address)
                return True
        self._without_room.add(name)
        return False

    def show(self, *names: str, label: str, class_: str = "") -> Markup:
        """Stored pictures of one size, one over the other; the class `over` marks those that lie above the first."""
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

    def store(self) -> Markup:
        """The element that holds all pictures: once a page, hidden."""
        return tag("svg", tag("defs", *self._stored.values()), class_="store", aria_hidden="true", width=0, height=0)


def data_uri(image: Image8) -> str:
    """A picture as an address that holds it, without loss: a fifth smaller than as a PNG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="WEBP", lossless=True, quality=50, method=3, exact=True)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"
