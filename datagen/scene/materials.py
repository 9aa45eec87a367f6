"""The materials of a scene's objects, one class each: to scene.json, to Mitsuba, and to the tracer of light paths."""

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, Self, get_args

import numpy as np
from jaxtyping import Float

from datagen.disk.errors import HyalineError
from datagen.disk.records import checked
from datagen.disk.storage import check_relative
from datagen.scene.substances import Dispersion, Ior, check_dispersion, check_ior, index_of, indices_of

# Numbers


Vector = tuple[float, float, float]
Color = tuple[float, float, float]
"""Linear Rec. 709 reflectance or radiance."""


def as_vector(values: Float[np.ndarray, "3"]) -> Vector:
    """Three numbers of an array."""
    x, y, z = values.tolist()
    return x, y, z


def check_positive(name: str, value: float) -> None:
    """Checks that a number is finite and above 0."""
    if not (math.isfinite(value) and value > 0):
        raise HyalineError(f"{name}: is {value}; expected a positive number")


def check_range(name: str, color: Color, low: float, high: float) -> None:
    """Checks that all components of a colour or vector are finite and within [low, high]."""
    if not all(math.isfinite(value) and low <= value <= high for value in color):
        raise HyalineError(f"{name}: is {color}; expected three numbers from {low:g} to {high:g}")


# Colours of surfaces: one colour, a procedural texture, or an image


@checked
@dataclass(frozen=True, kw_only=True)
class SolidTexture:
    """A procedural 3D texture, which has no seams; baked into the object's atlas (datagen/scene/textures.py)."""

    pattern: Literal["checker", "stripes", "wood", "marble", "speckle"]
    colors: tuple[Color, Color]
    """Linear reflectance, each in [0, 1]."""
    scale: float
    """Length of one period in metres."""
    axis: Literal["x", "y", "z"] = "x"
    """Axis that stripes and wood rings run across; the other patterns ignore it."""
    origin: Vector = (0.0, 0.0, 0.0)
    """Origin of the pattern in metres; it moves with the object."""

    def __post_init__(self) -> None:
        for color in self.colors:
            check_range("texture color", color, 0, 1)
        check_positive("texture scale", self.scale)

    def moved(self, offset: Vector) -> Self:
        """The texture of an object moved by an offset in metres."""
        return dataclasses.replace(self, origin=as_vector(np.add(self.origin, offset)))


@checked
@dataclass(frozen=True, kw_only=True)
class ImageTexture:
    """An sRGB image in the object's own uv."""

    path: str
    """PNG, relative to the scene's folder."""

    def __post_init__(self) -> None:
        check_relative(self.path, where="texture path")
        if not self.path.endswith((".png", ".PNG")):
            raise HyalineError(f"texture path: is {self.path!r}; expected a PNG inside the scene's folder")


Texture = SolidTexture | ImageTexture
Reflectance = Color | SolidTexture | ImageTexture


# What every material provides


MAX_PRIORITY = 9

MIRROR_IOR = 1e6
"""Index of refraction by which Fresnel's equations mirror everything at every angle."""

Plugin = dict[str, object]
"""A Mitsuba plugin as a dictionary for `mi.load_dict`."""

TexturePlugin = Callable[[Reflectance], Plugin]
"""Makes Mitsuba's texture from a reflectance, baked for the object's mesh."""

Event = Literal["ends", "coated", "mirrors", "passes", "refracts"]
"""What happens to a ray that hits a surface: it

- ends;
- ends, and a clear coat of index `ior` and GGX roughness `roughness` reflects a share by Fresnel's equations;
- ends, and metal of GGX roughness `roughness` reflects the share `color`;
- passes straight through a thin pane of index `ior` and tint `color`, which also reflects, or
- is refracted with tint `color`, or reflected, where the medium of a solid begins or ends, by facets of GGX roughness
  `roughness`.
"""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """How a surface affects a ray (datagen/trace/surface_hits.py); an event ignores values that it has no use for."""

    event: Event
    ior: float = 1.0
    """Index of refraction of a coat or a pane; `MIRROR_IOR` of a metal."""
    roughness: float = 0.0
    """Microfacet (GGX) alpha of a coat, a metal or solid glass; 0 is smooth."""
    color: Color = (1.0, 1.0, 1.0)
    """Share that a metal reflects, or that a pane or glass surface transmits of the light that it does not reflect."""
    texture: Texture | None = None
    """Texture of a metal's reflected share, multiplied by `color`."""


@dataclass(frozen=True, kw_only=True)
class Medium:
    """The refracting inside of a closed mesh: glass or a liquid (datagen/scene/media.py)."""

    iors: Color
    """Absolute index of refraction by channel; air has 1."""
    absorption: Color
    """Absorption coefficient in 1/m by channel."""
    priority: int
    """Where solids overlap, the one with the highest priority fills the space."""

    @property
    def ior(self) -> float:
        """Index of refraction for yellow-green light."""
        return self.iors[1]


@dataclass(frozen=True, kw_only=True)
class Optics(ABC):
    """A material: a frozen record whose fields are its keys in scene.json, and what follows from them.

    A field for a texture may have any name: moving, saving and baking find all textures.
    """

    is_glass: ClassVar[bool] = False
    """Whether it is transparent: not in masks of opaque objects, and made opaque by the edit `glass`."""

    @abstractmethod
    def bsdf(self, texture: TexturePlugin) -> Plugin:
        """How Mitsuba renders the surface."""

    @abstractmethod
    def surface(self) -> Surface:
        """How the tracer of light paths follows light at the surface."""

    @property
    def medium(self) -> Medium | None:
        """The medium inside; None for a surface material, whose mesh may be open."""
        return None

    def textures(self) -> dict[str, Texture]:
        """The textures, by field name."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: value for name, value in fields.items() if isinstance(value, Texture)}

    def images(self) -> dict[str, ImageTexture]:
        """The image textures, by field name."""
        return {name: value for name, value in self.textures().items() if isinstance(value, ImageTexture)}

    def with_fields(self, changes: Mapping[str, Texture]) -> Self:
        """The material with its textures in these fields replaced."""
        return dataclasses.replace(self, **changes) if changes else self

    def moved(self, offset: Vector) -> Self:
        """The material of an object moved by an offset in metres: its procedural textures move with it."""
        solids = {name: value for name, value in self.textures().items() if isinstance(value, SolidTexture)}
        return self.with_fields({name: value.moved(offset) for name, value in solids.items()})


def rgb(color: Color) -> Plugin:
    """A colour as a Mitsuba plugin."""
    return {"type": "rgb", "value": [float(value) for value in color]}


def check_reflectance(color: Reflectance) -> None:
    """Checks that a colour does not exceed 1; textures check themselves."""
    if isinstance(color, tuple):
        check_range("color", color, 0, 1)


def check_roughness(roughness: float) -> None:
    """Checks that a microfacet alpha is in the range of Mitsuba's sampling."""
    if not 0.001 <= roughness <= 1:
        raise HyalineError(f"roughness: is {roughness}; expected 0.001 to 1")


# Glass and liquids


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
    """Share of light transmitted each time it crosses the surface, at all angles; 0 to 1. A slab shows its square."""
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
        if not -MAX_PRIORITY <= self.priority <= MAX_PRIORITY:
            raise HyalineError(f"priority: is {self.priority}; expected {-MAX_PRIORITY} to {MAX_PRIORITY}")

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


@checked
@dataclass(frozen=True, kw_only=True)
class ThinDielectric(Optics):
    """A pane so thin that light passes straight through, with its inner reflections summed; may be an open mesh."""

    is_glass: ClassVar[bool] = True

    ior: Ior = 1.5
    """Index of refraction, or the name of a substance."""
    tint: Color = (1.0, 1.0, 1.0)
    """Transmitted share of the light that is not reflected, at every angle; each in [0, 1]."""

    def __post_init__(self) -> None:
        check_ior(self.ior)
        check_range("tint", self.tint, 0, 1)

    def bsdf(self, texture: TexturePlugin) -> Plugin:  # noqa: ARG002
        """A pane without thickness."""
        pane: Plugin = {"type": "thindielectric", "int_ior": index_of(self.ior), "ext_ior": 1.0}
        return pane if self.tint == (1, 1, 1) else {**pane, "specular_transmittance": rgb(self.tint)}

    def surface(self) -> Surface:
        """Passes light straight through, and reflects the light of both its faces."""
        return Surface(event="passes", ior=index_of(self.ior), color=self.tint)


# Opaque surfaces


@checked
@dataclass(frozen=True, kw_only=True)
class Diffuse(Optics):
    """Matt: Lambertian on both sides."""

    color: Reflectance

    def __post_init__(self) -> None:
        check_reflectance(self.color)

    def bsdf(self, texture: TexturePlugin) -> Plugin:
        """Lambert's law, on both sides."""
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(self.color)}}

    def surface(self) -> Surface:
        """Ends every path."""
        return Surface(event="ends")


@checked
@dataclass(frozen=True, kw_only=True)
class Plastic(Optics):
    """A diffuse base under a clear coat: plastic, varnish, glaze."""

    color: Reflectance
    ior: Ior = 1.5
    """Index of refraction of the coat, or the name of a substance."""
    roughness: float = 0.1
    """Microfacet (GGX) alpha of the coat."""

    def __post_init__(self) -> None:
        check_reflectance(self.color)
        check_roughness(self.roughness)
        check_ior(self.ior)
        if index_of(self.ior) == 1:
            raise HyalineError("ior: is 1, and a coat of that index shows nothing; expected more, or Diffuse")

    def bsdf(self, texture: TexturePlugin) -> Plugin:
        """The base with interreflection below the coat, on both sides."""
        plastic = {"type": "roughplastic", "diffuse_reflectance": texture(self.color), "nonlinear": True}
        coat = {"int_ior": index_of(self.ior), "ext_ior": 1.0, "alpha": self.roughness, "distribution": "ggx"}
        return {"type": "twosided", "bsdf": plastic | coat}

    def surface(self) -> Surface:
        """Ends the path; its coat reflects."""
        return Surface(event="coated", ior=index_of(self.ior), roughness=self.roughness)


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
        if isinstance(self.color, Texture):
            return Surface(event="mirrors", ior=MIRROR_IOR, roughness=self.roughness, texture=self.color)
        return Surface(event="mirrors", ior=MIRROR_IOR, roughness=self.roughness, color=self.color)


Material = Dielectric | RoughDielectric | ThinDielectric | Diffuse | Plastic | Conductor
"""Every material that can be described, rendered and traced (docs/extending.md)."""


def check_material(material: object, *, where: str) -> None:
    """Accepts the six material classes only; a subclass would render as its base."""
    known = get_args(Material)
    if type(material) not in known:
        names = ", ".join(choice.__name__ for choice in known)
        raise HyalineError(f"{where}: its material is a {type(material).__name__}; expected one of {names}")
