"""Panes too thin to bend light."""

from dataclasses import dataclass
from typing import ClassVar

from datagen.disk.records import checked
from datagen.scene.materials.optics import Optics, Plugin, Surface, TexturePlugin, rgb
from datagen.scene.substances import Ior, check_ior, index_of
from datagen.scene.values import Color, check_range


@checked
@dataclass(frozen=True, kw_only=True)
class ThinDielectric(Optics):
    """A pane so thin that light passes straight through, with its inner reflections summed; may be an open mesh."""

    is_glass: ClassVar[bool] = True

    ior: Ior = 1.5
    """Index of refraction, or the name of a substance."""
    tint: Color = (1.0, 1.0, 1.0)
    """Transmitted share of the light that is not reflected, at every angle; each in [0, 1]."""

    def __post_init__(self) -> None:
        check_ior(self.ior)
        check_range("tint", self.tint, 0, 1)

    def bsdf(self, texture: TexturePlugin) -> Plugin:  # noqa: ARG002
        """A pane without thickness."""
        pane: Plugin = {"type": "thindielectric", "int_ior": index_of(self.ior), "ext_ior": 1.0}
        return pane if self.tint == (1, 1, 1) else {**pane, "specular_transmittance": rgb(self.tint)}

    def surface(self) -> Surface:
        """Passes light straight through, and reflects the light of both its faces."""
        return Surface(event="passes", ior=index_of(self.ior), color=self.tint)
