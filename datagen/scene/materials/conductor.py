"""Metals."""

from dataclasses import dataclass

from datagen.scene.materials.optics import Optics, Plugin, Surface, TexturePlugin, rgb
from datagen.scene.values import Color, check_range, check_roughness


@dataclass(frozen=True, kw_only=True)
class Conductor(Optics):
    """Metal, described by its reflectance at normal incidence."""

    color: Color
    roughness: float = 0.1
    """Microfacet (GGX) alpha; 0 is a mirror."""

    def __post_init__(self) -> None:
        check_range("metal color", self.color, 0, 1)
        if self.roughness != 0:
            check_roughness(self.roughness)

    def bsdf(self, texture: TexturePlugin) -> Plugin:  # noqa: ARG002
        """A perfect mirror or one of facets, whose reflectance is the colour at every angle; on both sides."""
        metal: Plugin = {"type": "conductor", "material": "none", "specular_reflectance": rgb(self.color)}
        if self.roughness > 0:
            metal |= {"type": "roughconductor", "alpha": self.roughness, "distribution": "ggx"}
        return {"type": "twosided", "bsdf": metal}

    def surface(self) -> Surface:
        """Ends the path, and mirrors in its colour."""
        return Surface(event="mirrors", roughness=self.roughness, color=self.color)
