"""The flags of `datagen capture`: properties that pictures and masks do not determine."""

import re
from dataclasses import dataclass
from typing import Literal

from datagen.disk.errors import HyalineError

MAX_LONGEST = 4096


@dataclass(frozen=True, kw_only=True)
class CaptureChoices:
    """The flags of `datagen capture`."""

    longest: int = 256
    """Longer side of the dataset's pictures in pixels; larger pictures are reduced, averaging linear light."""
    scale: float | None = None
    """Metres per unit of the cameras. Default: 1 with a transforms file; otherwise a unit that puts them 1 m away."""
    diameter: str | None = None
    """True diameter in metres of one glass object at its widest place, such as tumbler=0.08, to find the scale."""
    up: Literal["auto", "x", "y", "z"] = "auto"
    """The axis of the cameras' world that points up. auto: z with a transforms file; otherwise perpendicular to the
    largest surface below the cameras."""

    def __post_init__(self) -> None:
        if not 8 <= self.longest <= MAX_LONGEST:
            raise HyalineError(f"--longest: is {self.longest}; expected 8 to {MAX_LONGEST:,} pixels")
        if self.scale is not None and not 1e-9 < self.scale < 1e9:
            raise HyalineError(f"--scale: is {self.scale:g}; expected metres per unit, such as 0.001 for millimetres")
        if self.scale is not None and self.diameter is not None:
            raise HyalineError("--diameter: gives the scale, as --scale does; leave one of them out")
        if self.diameter is not None:
            self.known_diameter()

    def known_diameter(self) -> tuple[str, float]:
        """The object of `diameter`, and its metres."""
        from datagen.scene.description import OBJECT_NAME  # Not before: help needs no NumPy.

        match = re.fullmatch(rf"({OBJECT_NAME})=(\d*\.?\d+)", self.diameter or "")
        if match is None or not 0 < float(match[2]) < 100:
            raise HyalineError(f"--diameter: is {self.diameter!r}; expected an object and metres, such as tumbler=0.08")
        return match[1], float(match[2])
