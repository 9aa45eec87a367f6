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
from datagen.scene.shading_normals import unit
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
BRIGHT_ENOUGH = 0.9
"""Share of its light that a base must be able to show through its coat; else it is drawn without one."""
METAL_ENOUGH = 0.5
"""Share of its light that rough metal must be able to mirror; other renderers give back what ours loses."""
MIN_TRANSMITTANCE = 1e-4
"""Least share of a channel after the attenuation distance; 0 would mean infinite absorption."""
ANGLES, POINTS = 64, 32
"""Directions that light comes from, and facets a side of the square that each of them meets."""


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
        if foreign.metallic >= 0.5 and metal_share(alpha) < METAL_ENOUGH:
            told("is brighter than metal so rough is drawn; drawn matt, of its colour")
            return Diffuse(color=self._reflectance(foreign))
        if foreign.metallic >= 0.5:
            roughness = 0.0 if foreign.roughness**2 < MIN_ALPHA else alpha
            return Conductor(color=self._reflectance(foreign), roughness=roughness)
        if foreign.is_base:
            return Plastic(color=self._reflectance(foreign), ior=foreign.ior, roughness=alpha)
        coat = coat_of(foreign.ior, alpha)
        if foreign.roughness < MATT:
            colors = _colors(foreign)
            wanted, shown = (1 - coat.mirrored) * colors, coat.seen(np.minimum(coat.base_of(colors), 1))
            if shown.sum() >= BRIGHT_ENOUGH * wanted.sum():
                return Plastic(color=self._reflectance(foreign, coat.base_of), ior=foreign.ior, roughness=alpha)
            told("is brighter than a base below so rough a coat can be; drawn matt, as bright as with its highlight")
        return Diffuse(color=self._reflectance(foreign, coat.with_mirrored))

    def _reflectance(
        self, foreign: ForeignMaterial, shaded: Callable[[np.ndarray], np.ndarray] = np.asarray
    ) -> Reflectance:
        """The base colour, or the image of it; as `shaded` makes of it."""
        colors = np.minimum(shaded(_colors(foreign)), 1)
        if foreign.image is None:
            return as_vector(colors)
        key = foreign.image, foreign.base_color, shaded
        if key not in self._paths:
            # Two materials may have one name.
            self._paths[key] = f"textures/{len(self._paths)}_{file_name(foreign.name)[:60]}.png"
            self.images[self._paths[key]] = png_bytes(to_8bit(srgb_from_linear(colors)))
        return ImageTexture(path=self._paths[key])


def _colors(foreign: ForeignMaterial) -> Float[np.ndarray, "*texels 3"]:
    """The base colour, or those of its image's texels."""
    if foreign.image is None:
        return np.array(foreign.base_color)
    return decoded(foreign.image)[..., :3].astype(np.float64) * np.array(foreign.base_color)


# Clear coats


@dataclass(frozen=True, kw_only=True)
class Coat:
    """The clear coat of `Plastic`: shares of light, averaged over all directions from which it comes evenly.

    Other renderers give the colour of a surface as it is seen, but for what its highlight mirrors. Ours is that of a
    base below a coat, out of which only some of the light finds its way: a base of 0.5 shows 0.28.
    """

    mirrored: float
    """Share of light from outside that the coat mirrors."""
    passed: float
    """Share that passes the coat both ways over a white base, without reflections back onto the base."""
    returned: float
    """Share of the base's scattered light that is reflected back onto it."""

    def seen(self, base: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """What light from everywhere shows of a base, without what the coat mirrors."""
        return self.passed * base / (1 - self.returned * base)

    def base_of(self, color: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """The base that is seen in a colour where the coat mirrors nothing; above 1 where there is none."""
        wanted = (1 - self.mirrored) * color
        return wanted / (self.passed + self.returned * wanted)

    def with_mirrored(self, color: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """A matt colour that is as bright as this one with what the coat mirrors."""
        return self.mirrored + (1 - self.mirrored) * color


@functools.lru_cache(maxsize=256)
def coat_of(ior: float, alpha: float) -> Coat:
    """The coat of index `ior` and GGX roughness `alpha`, as Mitsuba's `roughplastic` tabulates it.

    Facets that throw light onto others lose it there: white below a coat of alpha 0.35 shows 0.61 of the light.
    """
    mirrored, through = _shares(ior, alpha)
    returned, _ = _shares(1 / ior, alpha)
    return Coat(mirrored=mirrored, passed=(through / ior) ** 2, returned=returned)


@functools.lru_cache(maxsize=256)
def metal_share(alpha: float) -> float:
    """The share of even light that facets of white metal mirror; they lose what they throw onto each other."""
    return _shares(1e6, alpha)[0]


def _shares(eta: float, alpha: float) -> tuple[float, float]:
    """How much of even light facets mirror, and let through to the side of relative index `eta`.

    Source: visible facets as in Heitz 2018, "Sampling the GGX Distribution of Visible Normals"; Smith's shadowing.
    """
    cosine = (np.arange(ANGLES) + 0.5)[:, None, None] / ANGLES
    u, v = np.meshgrid((np.arange(POINTS) + 0.5) / POINTS, (np.arange(POINTS) + 0.5) / POINTS)
    wi = np.stack(np.broadcast_arrays(np.sqrt(1 - cosine**2), 0.0, cosine), axis=-1)
    stretched = unit(wi * (alpha, alpha, 1))
    # A point of the disk that is seen along the stretched direction.
    radius, angle = np.sqrt(u), 2 * np.pi * v
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    lean = (1 + stretched[..., 2]) / 2
    y = (1 - lean) * np.sqrt(1 - x**2) + lean * y
    across = np.zeros_like(stretched)
    across[..., 1] = 1.0
    facet = (
        x[..., None] * across
        + y[..., None] * np.cross(stretched, across)
        + np.sqrt(np.maximum(1 - x**2 - y**2, 0))[..., None] * stretched
    )
    m = unit(np.concatenate([alpha * facet[..., :2], np.maximum(facet[..., 2:], 1e-6)], axis=-1))
    cos_i = np.clip((wi * m).sum(axis=-1), 0, 1)
    cos_t = np.sqrt(np.maximum(1 - (1 - cos_i**2) / eta**2, 0))
    with np.errstate(invalid="ignore"):
        s, p = (cos_i - eta * cos_t) / (cos_i + eta * cos_t), (cos_t - eta * cos_i) / (cos_t + eta * cos_i)
    fresnel = np.where(cos_t > 0, (s**2 + p**2) / 2, 1.0)
    mirrored = 2 * cos_i * m[..., 2] - wi[..., 2]
    refracted = wi[..., 2] / eta - m[..., 2] * (cos_i / eta - cos_t)
    weights = 2 * cosine / ANGLES / POINTS**2
    return (
        float((weights * fresnel * _unshadowed(mirrored, alpha)).sum()),
        float((weights * (1 - fresnel) * _unshadowed(refracted, alpha)).sum()),
    )


def _unshadowed(cosine: np.ndarray, alpha: float) -> np.ndarray:
    """Share that other facets do not hide from a direction; none below the surface."""
    tangent2 = 1 / np.maximum(cosine, 1e-6) ** 2 - 1
    return np.where(cosine > 0, 2 / (1 + np.sqrt(1 + alpha**2 * np.maximum(tangent2, 0))), 0.0)
