"""The flags of the network benchmarks; torch is not imported, so that `--help` is fast."""

from dataclasses import dataclass

from datagen.disk.errors import HyalineError


@dataclass(frozen=True, kw_only=True)
class BenchChoices:
    """How large the benches' task is; the defaults are those of the paper."""

    pixels: int = 65_536
    """Pixels of a training step."""
    resolution: int = 512
    """Width and height of a frame in pixels."""
    objects: int = 11
    """Objects, each with a neural texture."""
    layers: int = 6
    """Straight layers of a pixel."""
    texture_size: int = 512
    """Width and height of a texture in texels."""
    features: int = 16
    """Channels of a texture."""
    rounds: int = 7
    """Rounds of every candidate, without warm-up."""

    def __post_init__(self) -> None:
        for name in ("pixels", "resolution", "objects", "layers", "texture_size", "features"):
            if getattr(self, name) < 2:
                raise HyalineError(f"{name}: is {getattr(self, name)}; expected at least 2")
        if self.objects > 255:
            raise HyalineError(f"objects: is {self.objects}; expected at most 255")
