"""Pictures inside a page: each is stored once and shown wherever it is needed, also laid over another."""

import base64
import io

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from datagen.pages.html import Markup, tag


class Gallery:
    """The pictures of a page, which are kept below a number of bytes."""

    def __init__(self, most_bytes: int) -> None:
        self._most = most_bytes
        self._used = 0
        self._images: dict[str, Markup] = {}
        self._sizes: dict[str, tuple[int, int]] = {}
        self.left_out = 0
        """Pictures for which no room was left."""

    def add(self, name: str, image: UInt8[np.ndarray, "h w c"] | UInt8[np.ndarray, "h w"]) -> bool:
        """Stores a picture under a name; False where there is no room for it. One that is there already stays."""
        if name in self._images:
            return True
        address = data_uri(image)
        if self._used + len(address) > self._most:
            self.left_out += 1
            return False
        self._used += len(address)
        height, width = image.shape[:2]
        self._images[name] = tag("image", id=name, width=width, height=height, href=address)
        self._sizes[name] = (width, height)
        return True

    def show(self, *names: str, label: str, class_: str = "") -> Markup:
        """Stored pictures of one size, one over the other; the class `over` marks those that lie above the first."""
        width, height = self._sizes[names[0]]
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
        return tag("svg", tag("defs", *self._images.values()), class_="store", aria_hidden="true", width=0, height=0)


def data_uri(image: UInt8[np.ndarray, "h w c"] | UInt8[np.ndarray, "h w"]) -> str:
    """A picture as an address that holds it, without loss: a fifth smaller than as a PNG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="WEBP", lossless=True, quality=50, method=3, exact=True)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"
