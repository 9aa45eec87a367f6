"""The dataset of pane and floor, which needs no Mitsuba (datagen/builder/synthetic.py)."""

from datagen.builder.synthetic import (
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
