"""The dataset of pane and floor, which needs no Mitsuba (datagen/build/synthetic.py)."""

from datagen.build.synthetic import (
    HEIGHTS,
    look_at,
    pixel_rays,
    quad,
    shade,
    synthetic_scene,
    trace,
    write_synthetic_dataset,
)

__all__ = [
    "HEIGHTS",
    "look_at",
    "pixel_rays",
    "quad",
    "shade",
    "synthetic_scene",
    "trace",
    "write_synthetic_dataset",
]
