"""The materials of a scene's objects: one file each, and one entry in `Material`."""

from typing import get_args

from datagen.disk.errors import HyalineError
from datagen.scene.materials.conductor import Conductor
from datagen.scene.materials.dielectric import Dielectric
from datagen.scene.materials.diffuse import Diffuse
from datagen.scene.materials.plastic import Plastic
from datagen.scene.materials.rough_dielectric import RoughDielectric
from datagen.scene.materials.thin_dielectric import ThinDielectric

Material = Dielectric | RoughDielectric | ThinDielectric | Diffuse | Plastic | Conductor
"""Every material that can be described, rendered and traced (docs/adding-a-material.md)."""

__all__ = [
    "Conductor",
    "Dielectric",
    "Diffuse",
    "Material",
    "Plastic",
    "RoughDielectric",
    "ThinDielectric",
    "check_material",
]


def check_material(material: object, *, where: str) -> None:
    """Accepts the six material classes only; a subclass would render as its base."""
    known = get_args(Material)
    if type(material) not in known:
        names = ", ".join(choice.__name__ for choice in known)
        raise HyalineError(f"{where}: its material is a {type(material).__name__}; expected one of {names}")
