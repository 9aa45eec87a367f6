"""Pictures that notebooks show: arrays side by side, and sketches of meshes."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

from datagen.data.meshes import Mesh, is_there

HEIGHT = 256
"""Pixels of a picture in a notebook: small ones are enlarged without smoothing."""
GAP = 4
SKETCH = (640, 480)
AROUND = 0.35
"""Room around the glass in a sketch, as a share of its size."""


def in_a_row(pictures: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> Image.Image:
    """Pictures of one height side by side, on white."""
    height = len(pictures[0])
    white = np.full((height, max(1, GAP * height // HEIGHT), 3), 255, np.uint8)
    parts = [part for picture in pictures for part in (picture, white)][:-1]
    row = Image.fromarray(np.hstack(parts))
    scale = max(1, HEIGHT // height)
    return row.resize((scale * row.width, scale * row.height), Image.Resampling.NEAREST)


def sketch(meshes: Sequence[Mesh], is_glass: Sequence[bool], azimuth_deg: float) -> UInt8[np.ndarray, "h w 3"]:
    """Meshes as a pen would draw them, around the glass; around all of them where there is none.

    Args:
        azimuth_deg: side of the scene from which they are seen, from +x towards +y.
    """
    from datagen.look.sketch import draw_sketch, fit_viewpoint

    there = [mesh for mesh in meshes if is_there(mesh)]
    subject = [mesh for mesh, glass in zip(meshes, is_glass, strict=True) if glass and is_there(mesh)] or there
    corners = np.concatenate([mesh.vertices for mesh in subject]).astype(np.float64)
    low, high = corners.min(axis=0), corners.max(axis=0)
    room = AROUND * (high - low).max()
    around = np.stack(np.meshgrid(*np.stack([low - room, high + room], axis=-1)), axis=-1).reshape(-1, 3)
    width, height = SKETCH
    viewpoint = fit_viewpoint(around, azimuth_deg, 20.0, width=width, height=height)
    glass: Bool[np.ndarray, " mesh"] = np.array(is_glass, bool)
    drawn = draw_sketch(tuple(meshes), glass, viewpoint).picture.astype(np.float64)
    alpha = drawn[..., 3:] / 255
    return (alpha * drawn[..., :3] + (1 - alpha) * 255).astype(np.uint8)
