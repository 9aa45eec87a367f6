"""Resolution: how many pixels wide and high pictures are, and how commands read and print that."""

import math
import re
from dataclasses import dataclass
from typing import Self

from datagen.disk.errors import HyalineError
from datagen.disk.records import shown

MAX_SIDE = 8192
"""Pixels: what is larger has a slip in it."""


@dataclass(frozen=True, kw_only=True)
class Resolution:
    """Width and height of pictures in pixels, which are square."""

    width: int
    height: int

    def __post_init__(self) -> None:
        for value in (self.width, self.height):
            if not 1 <= value <= MAX_SIDE:
                raise HyalineError(f"resolution: is {value}; expected 1 to {MAX_SIDE} pixels")

    def __str__(self) -> str:
        return f"{self.width} x {self.height}"

    @property
    def pixels(self) -> int:
        """Of one picture."""
        return self.width * self.height

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, the order of an array's axes."""
        return self.height, self.width

    @property
    def shorter(self) -> int:
        """The shorter of both sides."""
        return min(self.width, self.height)

    @property
    def mean_side(self) -> int:
        """Side of the square with as many pixels, rounded down: what textures are as fine as."""
        return math.isqrt(self.pixels)

    @property
    def is_power_of_two_square(self) -> bool:
        """True for 64 x 64 and its likes."""
        return self.width == self.height and self.width & (self.width - 1) == 0

    def times(self, scale: int) -> Self:
        """So many times as wide and high."""
        return type(self)(width=scale * self.width, height=scale * self.height)


def square(side: int) -> Resolution:
    """The resolution of square pictures."""
    return Resolution(width=side, height=side)


def parse_resolution(text: str) -> Resolution:
    """The resolution that a user wrote: `256` is 256 x 256 pixels, `320x240` is 320 wide and 240 high.

    Raises:
        HyalineError: it is neither, or is out of range.
    """
    found = re.fullmatch(r"(-?[0-9]{1,9})(?: ?x ?(-?[0-9]{1,9}))?", text.strip())
    if found is None:
        raise HyalineError(f"resolution: is {shown(text)}; expected a width and height such as 320x240, or one number")
    width, height = found[1], found[2] or found[1]
    return Resolution(width=int(width), height=int(height))
