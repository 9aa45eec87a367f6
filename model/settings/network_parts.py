"""The kinds of network parts that a configuration can name, and the numbers that they take; torch is not needed."""

import math
from typing import Literal

from datagen.disk.errors import HyalineError

Extrinsics = Literal["none", "view", "sh"]

EXTRINSIC_CHANNELS: dict[Extrinsics, int] = {"none": 0, "view": 3, "sh": 9}
"""Inputs that each layer gets besides its features. Source: paper section 4.6."""

Norm = Literal["batch", "none"]

UNetNorm = Literal["instance", "batch"]

VggKind = Literal["vgg16", "vgg19"]


MOST_RAYS = 1024
"""Rays per pixel, in training and in rendering."""


def check_width(width: int, blocks: int) -> None:
    """Raises a HyalineError where a width cannot be halved `blocks` times."""
    if width < 1 or blocks < 0 or width % (1 << blocks):
        raise HyalineError(f"hidden: is {width} with {blocks} blocks; expected a multiple of {1 << max(blocks, 0)}")


def check_samples(name: str, samples: int) -> None:
    """Raises a HyalineError unless this number of cells tiles a pixel as a square grid."""
    if not 1 <= samples <= MOST_RAYS or math.isqrt(samples) ** 2 != samples:
        raise HyalineError(f"{name}: is {samples}; expected a square number of rays per pixel, 1 to {MOST_RAYS}")


def check_texels(name: str, size: int, *, is_open: bool = False) -> None:
    """Raises a HyalineError unless a texture can have this width in texels; with `is_open`, 0 leaves it open."""
    if not (2 <= size <= 8192 or (is_open and size == 0)):
        raise HyalineError(f"{name}: is {size}; expected 2 to 8192 texels")
