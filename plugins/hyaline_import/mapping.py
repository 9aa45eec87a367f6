"""From the material of a foreign file to one of ours; whatever it cannot say is a line of import.json.

Formulas: glTF's extensions KHR_materials_transmission, _volume, _ior and _dispersion.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from datagen.data.images import png_bytes, srgb_from_linear, to_8bit
from datagen.data.meshes import Mesh
from datagen.disk.storage import file_name
from datagen.render.albedo import mirrored_by_coat
from datagen.scene.materials import (
    Color,
    Conductor,
    Dielectric,
    Diffuse,
    ImageTexture,
    Material,
    Plastic,
    Reflectance,
    RoughDielectric,
    ThinDielectric,
    as_vector,
)
from datagen.scene.substances import MAX_DISPERSION
from hyaline_import.foreign import ForeignImage, ForeignMaterial
from hyaline_import.pictures import SOLID_BLEND, decoded, mean_color, stored, values_on
from hyaline_import.remarks import Remarks

MIN_ALPHA = 0.001
"""Smallest GGX alpha that is rendered; below it a surface is smooth."""
SMOOTH_ALPHA = 0.0025
"""GGX alpha below which facets are invisible in glass."""
MATT = 0.6
"""Perceptual roughness from which on no highlight is seen."""
MIN_TRANSMITTANCE = 1e-4
"""Least share of a channel after the attenuation distance; 0 would mean infinite absorption."""


@dataclass(frozen=True, kw_only=True)
class Mapper:
    """Maps materials; PNGs of the images that it needs gather in `images` by path."""

    metres: float
    """Metres a unit of the file."""
    remarks: Remarks
    images: dict[str, bytes] = field(default_factory=dict)
    _paths: dict[tuple[ForeignImage, Color, Callable], str] = field(default_factory=dict)

    def averaged(self, foreign: ForeignMaterial, mesh: Mesh, *, has_uv: bool, where: str) -> ForeignMaterial:
        """The material with each factor times the mean of its image over the surface: ours have one value each."""
        if not foreign.factor_images:
            return foreign
        factors: dict[str, float] = {}
        for use in foreign.factor_images:
            values = stored(use.image)[..., use.channel] / 255
            seen = values_on(mesh, values) if has_uv and use.lies_as_color else values
            # Rounded, so that objects that differ by nothing that one sees share their images.
            mean = round(float(seen.mean()), 2)
            factor: float = getattr(foreign, use.factor)
            factors[use.factor] = factor * mean
        told = " and ".join(f"{name} {value:.2f}" for name, value in factors.items())
        self.remarks.approximate(where, f"has images of its factors; drawn with their means: {told}")
        return dataclasses.replace(foreign, factor_images=(), **factors)

    def material(self, foreign: ForeignMaterial, *, is_closed: bool, has_uv: bool, where: str) -> Material:
        """The material of ours that comes nearest, on a mesh that is closed or open, with or without uv."""
        is_blended = foreign.alpha_mode == "blend" and foreign.alpha < 1
        is_glass, told = foreign.is_glass, functools.partial(self.remarks.approximate, where)
        is_pane = is_blended and not is_glass and foreign.alpha < SOLID_BLEND
        if foreign.image is not None and (is_glass or is_pane or not has_uv):
            told("has an image where only one colour can be; drawn in its mean colour")
            color = as_vector(np.multiply(foreign.base_color, mean_color(foreign.image)))
            foreign = dataclasses.replace(foreign, image=None, base_color=color)
        if is_blended:
            kind = "as glass alone" if is_glass else "as a thin pane of that colour" if is_pane else "opaque"
            told(f"is blended with alpha {foreign.alpha:.2g}; drawn {kind}")
        if is_glass:
            if foreign.transmission < 1:
                told(f"lets {100 * foreign.transmission:.0f} % of the light through; drawn as clear glass")
            return self._glass(foreign, told, is_closed=is_closed, where=where)
        if is_pane:  # White where it is not there.
            red, green, blue = (1 - foreign.alpha + foreign.alpha * c for c in foreign.base_color)
            return ThinDielectric(ior=foreign.ior, tint=(red, green, blue))
        if foreign.transmission > 0:
            told(f"is drawn opaque, and lets no light through (transmission {foreign.transmission:.2g})")
        return self._opaque(foreign, told)

    def _glass(self, foreign: ForeignMaterial, told: Callable[[str], None], *, is_closed: bool, where: str) -> Material:
        alpha, dispersion = min(foreign.roughness**2, 1.0), min(foreign.dispersion, MAX_DISPERSION)
        if not is_closed or foreign.is_thin:
            if foreign.is_volume:
                told("is solid; drawn as thin glass: its mesh is open, --repair may close it")
            elif not is_closed:
                self.remarks.note(where, "its mesh is open: drawn as thin glass, which light crosses without bending")
            if alpha > SMOOTH_ALPHA:
                told(f"is a rough pane (GGX alpha {alpha:.2g}); drawn smooth")
            if dispersion > 0 or (foreign.is_volume and max(self._absorption(foreign)) > 0):
                told("its dispersion and absorption are left out, since a thin pane has no depth")
            return ThinDielectric(ior=foreign.ior, tint=foreign.base_color)
        if not foreign.is_volume:
            self.remarks.note(where, "the file gives it no volume, and its mesh is closed: drawn as solid glass")
        if dispersion < foreign.dispersion:
            told(f"has a dispersion of {foreign.dispersion:g}; drawn with {dispersion:g}")
        solid = Dielectric(
            ior=foreign.ior,
            absorption=self._absorption(foreign),
            tint=as_vector(np.sqrt(foreign.base_color)),  # Light crosses two surfaces, and then is of that colour.
            dispersion=dispersion,
        )
        return RoughDielectric(**vars(solid), roughness=alpha) if alpha > SMOOTH_ALPHA else solid

    def _absorption(self, foreign: ForeignMaterial) -> Color:
        """1/m: after the attenuation distance, light is the attenuation colour. Source: KHR_materials_volume."""
        distance = foreign.attenuation_distance * self.metres
        red, green, blue = (
            a / self.metres - math.log(min(max(c, MIN_TRANSMITTANCE), 1.0)) / distance
            for a, c in zip(foreign.absorption, foreign.attenuation_color, strict=True)
        )
        return red, green, blue

    def _opaque(self, foreign: ForeignMaterial, told: Callable[[str], None]) -> Material:
        alpha = max(foreign.roughness**2, MIN_ALPHA)
        if 0.1 < foreign.metallic < 0.9:
            kind = "metal" if foreign.metallic >= 0.5 else "no metal"
            told(f"is {100 * foreign.metallic:.0f} % metal; drawn as {kind}")
        if foreign.metallic >= 0.5:
            roughness = 0.0 if foreign.roughness**2 < MIN_ALPHA else alpha
            return Conductor(color=self._reflectance(foreign), roughness=roughness)
        if foreign.is_base:
            return Plastic(color=self._reflectance(foreign), ior=foreign.ior, roughness=alpha)
        coat = Coat(ior=foreign.ior, alpha=alpha)
        if foreign.roughness < MATT:
            return Plastic(color=self._reflectance(foreign, coat.base_of), ior=foreign.ior, roughness=alpha)
        return Diffuse(color=self._reflectance(foreign, coat.with_mirrored))

    def _reflectance(
        self, foreign: ForeignMaterial, shaded: Callable[[np.ndarray], np.ndarray] = np.asarray
    ) -> Reflectance:
        """The base colour, or the image of it; as `shaded` makes of it."""
        image = np.float64(1) if foreign.image is None else decoded(foreign.image)[..., :3].astype(np.float64)
        colors = np.minimum(shaded(image * np.array(foreign.base_color)), 1)
        if foreign.image is None:
            return as_vector(colors)
        key = foreign.image, foreign.base_color, shaded
        if key not in self._paths:
            # Two materials may have one name.
            self._paths[key] = f"textures/{len(self._paths)}_{file_name(foreign.name)[:60]}.png"
            self.images[self._paths[key]] = png_bytes(to_8bit(srgb_from_linear(colors)))
        return ImageTexture(path=self._paths[key])


@dataclass(frozen=True, kw_only=True)
class Coat:
    """The clear coat of `Plastic`: shares of light, averaged over all directions from which it comes evenly.

    Other renderers give the colour of a surface as it is seen, but for what its highlight mirrors. Ours is that of a
    base below a coat, out of which only some of the light finds its way: a base of 0.5 shows 0.28.
    """

    ior: float
    alpha: float

    @property
    def mirrored(self) -> float:
        """Share of light from outside that the coat mirrors."""
        return mirrored_by_coat(self.ior, self.alpha)

    def base_of(self, color: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """The base that is seen in a colour where the coat mirrors nothing."""
        returned = 1 - (1 - self.mirrored) / self.ior**2  # Of the base's scattered light, onto the base.
        return color / (1 - returned * (1 - color))

    def with_mirrored(self, color: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """A matt colour that is as bright as this one with what the coat mirrors."""
        return self.mirrored + (1 - self.mirrored) * color
