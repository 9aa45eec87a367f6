"""The presets of `paper`: the renderer as its authors published it, and the best that its idea gives."""

from dataclasses import dataclass
from typing import Literal

DEFAULT_STEPS = 2500
"""Of every method."""

PaperPresetName = Literal["published", "best"]


@dataclass(frozen=True, kw_only=True)
class PaperPreset:
    """What `model train --method paper` builds, and how it trains it, unless a flag says otherwise."""

    width: str
    """Hidden units: 34k (as many as make 34,000 parameters) or their number."""
    norm: Literal["batch", "none"]
    texture_levels: int
    finer_counts: float
    """How much a texture level counts beside the next coarser one."""
    texels_per_pixel: float
    """Width of an object's texture in widths of the picture."""
    rays: int
    render_rays: int
    steps: int
    batch: int
    """Pixels a step."""
    lr: float
    texture_lr: float | None
    """None: the same as the network's."""
    lr_decay: Literal["none", "linear", "cosine"]
    softness: float
    """Differences below it count by their squares (model/losses/pixel_losses.py)."""


PAPER_PRESETS: dict[PaperPresetName, PaperPreset] = {
    "published": PaperPreset(
        width="34k",
        norm="batch",
        texture_levels=1,
        finer_counts=1.0,
        texels_per_pixel=0.5,
        rays=1,
        render_rays=1,
        steps=DEFAULT_STEPS,
        batch=8192,
        lr=0.001,
        texture_lr=None,
        lr_decay="linear",
        softness=0.0,
    ),
    # Half as many rays a step in twice as many steps: as many rays as the published form trains on.
    "best": PaperPreset(
        width="128",
        norm="none",
        texture_levels=5,
        finer_counts=0.5,
        texels_per_pixel=1.0,
        rays=4,
        render_rays=16,
        steps=2 * DEFAULT_STEPS,
        batch=1024,
        lr=0.003,
        texture_lr=0.02,
        lr_decay="cosine",
        softness=0.03,
    ),
}
