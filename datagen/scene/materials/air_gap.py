"""Surfaces that light does not notice."""

from dataclasses import dataclass
from typing import ClassVar

from datagen.scene.materials.optics import Optics, Plugin, Surface, TexturePlugin


@dataclass(frozen=True, kw_only=True)
class AirGap(Optics):
    """A surface that is peeled, and does nothing to light."""

    is_glass: ClassVar[bool] = True

    def bsdf(self, texture: TexturePlugin) -> Plugin:  # noqa: ARG002
        """Mitsuba's surface without effect."""
        return {"type": "null"}

    def surface(self) -> Surface:
        """A pane of index 1 reflects nothing."""
        return Surface(event="passes", ior=1.0)
