"""Smooth solid glass and liquids."""

import math
from dataclasses import dataclass
from typing import ClassVar

from datagen.disk.records import checked
from datagen.scene.materials.optics import Medium, Optics, Plugin, Surface, TexturePlugin, rgb
from datagen.scene.substances import Dispersion, Ior, check_dispersion, check_ior, index_of, indices_of
from datagen.scene.values import Color, check_range


@checked
@dataclass(frozen=True, kw_only=True)
class Dielectric(Optics):
    """Smooth solid glass or liquid: refracts by Snell's law, reflects by Fresnel, absorbs by Beer and Lambert."""

    is_glass: ClassVar[bool] = True

    ior: Ior = 1.5
    """Absolute index of refraction (air has 1), or the name of a substance such as bk7, water or diamond."""
    absorption: Color = (0.0, 0.0, 0.0)
    """Absorption coefficient per channel, 1/m: transmittance over d metres is exp(-absorption d)."""
    tint: Color = (1.0, 1.0, 1.0)
    """Share of the light transmitted each time it crosses the surface, at every angle; each in [0, 1]. A slab shows its
    square."""
    priority: int = 0
    """-9 to 9. Where dielectrics overlap, the one with the highest priority fills the space, or the first in the scene
    if equal: give a drink, whose mesh extends slightly into the wall of its glass, -1."""
    dispersion: Dispersion = 0.0
    """20 over the Abbe number, as in glTF (crown glass 0.3, flint and crystal 0.5 to 0.8), or `measured` if `ior` names
    a substance with known lines. Red, green and blue then have different indices."""

    def __post_init__(self) -> None:
        check_ior(self.ior)
        check_dispersion(self.ior, self.dispersion)
        check_range("absorption", self.absorption, 0, math.inf)
        check_range("tint", self.tint, 0, 1)
        assert self.medium is not None  # It checks the priority.

    @property
    def medium(self) -> Medium:
        """The medium inside."""
        iors = indices_of(self.ior, self.dispersion)
        return Medium(iors=iors, absorption=self.absorption, priority=self.priority)

    def bsdf(self, texture: TexturePlugin) -> Plugin:  # noqa: ARG002
        """The surface between glass and air; our own integrator uses the media on its two sides instead."""
        glass: Plugin = {"type": "dielectric", "int_ior": index_of(self.ior), "ext_ior": 1.0}
        return glass if self.tint == (1, 1, 1) else {**glass, "specular_transmittance": rgb(self.tint)}

    def surface(self) -> Surface:
        """Refracts; the media on both sides follow from the solids that the ray is in."""
        return Surface(event="refracts", ior=index_of(self.ior), color=self.tint)
