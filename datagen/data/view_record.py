"""The record of one view of a dataset: how it was made, and the checksums of its files."""

import math
from dataclasses import dataclass

from datagen.data.config import Split


@dataclass(frozen=True, kw_only=True)
class ViewRecord:
    """What is known of one view; written last. What only a renderer knows is None where the view was imported."""

    dataset: str
    """The seal of the dataset that the view belongs to."""
    split: Split
    view: int
    seed: int | None = None
    spp: int | None = None
    """Samples per pixel that were really drawn, both halves together."""
    noise_mse: float | None = None
    """Estimated mean squared error of the clipped sRGB image against its own limit of infinitely many samples."""
    variant: str | None = None
    """The Mitsuba variant that rendered it."""
    files: dict[str, str]
    """SHA-256 by path, relative to the dataset."""

    @property
    def ceiling_db(self) -> float | None:
        """The PSNR in dB that the view's own noise would allow a perfect method; None where nobody knows it."""
        return None if self.noise_mse is None else -10 * math.log10(max(self.noise_mse, 1e-12))
