"""Colour under a clear coat: plastic, varnish, glaze."""

from dataclasses import dataclass

from datagen.disk.errors import HyalineError
from datagen.disk.records import checked
from datagen.scene.materials.optics import Optics, Plugin, Surface, TexturePlugin
from datagen.scene.substances import Ior, check_ior, index_of
from datagen.scene.textures import Reflectance, check_reflectance
from datagen.scene.values import check_roughness


@checked
@dataclass(frozen=True, kw_only=True)
class Plastic(Optics):
    """A diffuse base under a clear coat."""

    color: Reflectance
    ior: Ior = 1.5
    """Index of refraction of the coat, or the name of a substance."""
    roughness: float = 0.1
    """Microfacet (GGX) alpha of the coat."""

    def __post_init__(self) -> None:
        check_reflectance(self.color)
        check_ior(self.ior)
        check_roughness(self.roughness)
        if index_of(self.ior) == 1:
            raise HyalineError("ior: is 1, and a coat of that index shows nothing; expected more, or Diffuse")

    def bsdf(self, texture: TexturePlugin) -> Plugin:
        """The base with interreflection below the coat, on both sides."""
        plastic = {
            "type": "roughplastic",
            "diffuse_reflectance": texture(self.color),
            "int_ior": index_of(self.ior),
            "ext_ior": 1.0,
            "alpha": self.roughness,
            "distribution": "ggx",
            "nonlinear": True,
        }
        return {"type": "twosided", "bsdf": plastic}

    def surface(self) -> Surface:
        """Ends the path; its coat reflects."""
        return Surface(event="coated", ior=index_of(self.ior), roughness=self.roughness)
