"""Matt surfaces."""

from dataclasses import dataclass

from datagen.disk.records import checked
from datagen.scene.materials.optics import Optics, Plugin, Surface, TexturePlugin
from datagen.scene.textures import Reflectance, check_reflectance


@checked
@dataclass(frozen=True, kw_only=True)
class Diffuse(Optics):
    """Lambertian on both sides."""

    color: Reflectance

    def __post_init__(self) -> None:
        check_reflectance(self.color)

    def bsdf(self, texture: TexturePlugin) -> Plugin:
        """Lambert's law, on both sides."""
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(self.color)}}

    def surface(self) -> Surface:
        """Ends every path."""
        return Surface(event="ends")
