"""Panes too thin to bend light."""

from dataclasses import dataclass
from typing import ClassVar

from datagen.scene.materials.optics import Optics, Plugin, Surface, TexturePlugin
from datagen.scene.values import check_ior


@dataclass(frozen=True, kw_only=True)
class ThinDielectric(Optics):
    """A pane so thin that light goes straight through, with the reflections inside it summed; may be an open mesh."""

    is_glass: ClassVar[bool] = True

    ior: float = 1.5

    def __post_init__(self) -> None:
        check_ior(self.ior)

    def bsdf(self, texture: TexturePlugin) -> Plugin:  # noqa: ARG002
        """A pane without thickness."""
        return {"type": "thindielectric", "int_ior": self.ior, "ext_ior": 1.0}

    def surface(self) -> Surface:
        """Lets light through as it comes, and mirrors what both of its faces do."""
        return Surface(event="passes", ior=self.ior)
