"""Frosted solid glass."""

import dataclasses
from dataclasses import dataclass

from datagen.disk.records import checked
from datagen.scene.materials.dielectric import Dielectric
from datagen.scene.materials.optics import Plugin, Surface, TexturePlugin
from datagen.scene.substances import index_of
from datagen.scene.values import check_roughness


@checked
@dataclass(frozen=True, kw_only=True)
class RoughDielectric(Dielectric):
    """Solid glass or liquid with a microfacet surface: ground, frosted or etched glass, ice."""

    roughness: float = 0.1
    """Microfacet (GGX) alpha; 0 is smooth glass."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.roughness != 0:
            check_roughness(self.roughness)

    def bsdf(self, texture: TexturePlugin) -> Plugin:
        """Facets that refract and reflect; our own integrator samples them with the media on their two sides."""
        smooth = super().bsdf(texture)
        if self.roughness == 0 or index_of(self.ior) == 1:  # Mitsuba rejects facets of index 1, which do nothing.
            return smooth
        return {**smooth, "type": "roughdielectric", "alpha": self.roughness, "distribution": "ggx"}

    def surface(self) -> Surface:
        """Refracts at one of its facets."""
        return dataclasses.replace(super().surface(), roughness=self.roughness)
