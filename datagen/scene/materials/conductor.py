"""Metals."""

from dataclasses import dataclass

from datagen.disk.records import checked
from datagen.scene.materials.optics import Optics, Plugin, Surface, TexturePlugin
from datagen.scene.textures import ImageTexture, Reflectance, SolidTexture, check_reflectance
from datagen.scene.values import check_roughness


@checked
@dataclass(frozen=True, kw_only=True)
class Conductor(Optics):
    """Metal, described by its reflectance at normal incidence."""

    color: Reflectance
    roughness: float = 0.1
    """Microfacet (GGX) alpha; 0 is a mirror."""

    def __post_init__(self) -> None:
        check_reflectance(self.color)
        if self.roughness != 0:
            check_roughness(self.roughness)

    def bsdf(self, texture: TexturePlugin) -> Plugin:
        """A perfect or rough mirror with the colour as reflectance at every angle; on both sides."""
        metal: Plugin = {"type": "conductor", "material": "none", "specular_reflectance": texture(self.color)}
        if self.roughness > 0:
            metal |= {"type": "roughconductor", "alpha": self.roughness, "distribution": "ggx"}
        return {"type": "twosided", "bsdf": metal}

    def surface(self) -> Surface:
        """Ends the path, and reflects in its colour."""
        if isinstance(self.color, SolidTexture | ImageTexture):
            return Surface(event="mirrors", roughness=self.roughness, texture=self.color)
        return Surface(event="mirrors", roughness=self.roughness, color=self.color)
