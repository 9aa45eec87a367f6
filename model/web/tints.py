"""What metals mirror over their surface, as a page holds it: texels of datagen/trace/tints.py, each image once."""

import numpy as np

from datagen.data.tonemap import srgb_from_linear, to_8bit
from datagen.trace.tints import Texels, Tints
from model.web.packing import Packed, Quality

TintPlaces = list[list[int] | None]
"""For each object the first of its texels, and how many columns and rows they have; None where one colour says all."""


def add_tints(packed: Packed, tints: Tints, quality: Quality) -> TintPlaces:
    """Adds the texels of all metals that have any, row by row: linear floats; small: 8 bits of sRGB, as images have."""
    images: dict[bytes, tuple[int, Texels]] = {}
    places: TintPlaces = []
    count = 0
    for texels in tints:
        if texels is None:
            places.append(None)
            continue
        height, width, _ = texels.shape
        key = b"%d %d " % (height, width) + texels.tobytes()
        if key not in images:
            images[key] = (count, texels)
            count += height * width
        places.append([images[key][0], width, height])
    if images:
        linear = np.concatenate([texels.reshape(-1, 3) for _, texels in images.values()])
        if quality == "small":
            packed.add("tints", to_8bit(srgb_from_linear(linear)), differences=True)
        else:
            packed.add("tints", linear)
    return places
