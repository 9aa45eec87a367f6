"""What every material says about itself: to Mitsuba, to the tracer of light paths, and to edits."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

from datagen.disk.errors import HyalineError
from datagen.scene.textures import ImageTexture, Reflectance, SolidTexture
from datagen.scene.values import Color, Vector

MAX_PRIORITY = 9

Plugin = dict[str, object]
"""A plugin of Mitsuba's as `mi.load_dict` takes it."""

TexturePlugin = Callable[[Reflectance], Plugin]
"""Makes Mitsuba's texture of a reflectance, baked for the object's mesh."""

Event = Literal["ends", "coated", "mirrors", "passes", "refracts"]
"""What happens to a ray that meets a surface: it

- ends;
- ends, and a clear coat of index `ior` and GGX roughness `roughness` mirrors a share by Fresnel's equations;
- ends, and metal of GGX roughness `roughness` mirrors the share `color`;
- passes straight through a thin pane of index `ior` and tint `color`, which also mirrors, or
- is refracted, with tint `color`, or mirrored where the medium of a solid begins or ends, by facets of GGX roughness
  `roughness`.
"""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """What a surface does to a ray, as datagen/trace/surface_hits.py follows it; other events ignore a value."""

    event: Event
    ior: float = 1.0
    """Of a coat or a pane."""
    roughness: float = 0.0
    """Microfacet (GGX) alpha of a coat, a metal, or of solid glass; 0 is smooth."""
    color: Color = (1.0, 1.0, 1.0)
    """Share that a metal mirrors, or that a pane or the surface of glass lets through of what it does not mirror."""
    texture: SolidTexture | ImageTexture | None = None
    """Where that share of a metal differs from place to place: times `color`."""


@dataclass(frozen=True, kw_only=True)
class Medium:
    """What fills a closed mesh and bends light: glass or a liquid (datagen/scene/media.py)."""

    iors: Color
    """Absolute index of refraction by channel; air has 1."""
    absorption: Color
    """1/m, by channel."""
    priority: int
    """Where solids overlap, the one of the highest priority fills the space."""

    def __post_init__(self) -> None:
        if not -MAX_PRIORITY <= self.priority <= MAX_PRIORITY:
            raise HyalineError(f"priority: is {self.priority}; expected {-MAX_PRIORITY} to {MAX_PRIORITY}")

    @property
    def ior(self) -> float:
        """Of yellow-green light."""
        return self.iors[1]


@dataclass(frozen=True, kw_only=True)
class Optics(ABC):
    """A material: a frozen record whose fields are its keys in scene.json, and what follows from them.

    A field that holds a texture may have any name: whoever moves, saves or bakes textures finds them all.
    """

    is_glass: ClassVar[bool] = False
    """One sees through it: it is in no mask of opaque things, and the edit `glass` makes it opaque."""

    @abstractmethod
    def bsdf(self, texture: TexturePlugin) -> Plugin:
        """How Mitsuba renders the surface."""

    @abstractmethod
    def surface(self) -> Surface:
        """How the tracer of light paths follows light at the surface."""

    @property
    def medium(self) -> Medium | None:
        """What fills the inside; None for a material of surfaces, whose mesh may be open."""
        return None

    def textures(self) -> dict[str, SolidTexture | ImageTexture]:
        """The textures by the name of their field."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: value for name, value in fields.items() if isinstance(value, SolidTexture | ImageTexture)}

    def images(self) -> dict[str, ImageTexture]:
        """The textures that are images, by the name of their field."""
        return {name: value for name, value in self.textures().items() if isinstance(value, ImageTexture)}

    def solids(self) -> dict[str, SolidTexture]:
        """The textures that are carved from space, by the name of their field."""
        return {name: value for name, value in self.textures().items() if isinstance(value, SolidTexture)}

    def with_fields(self, changes: dict[str, SolidTexture | ImageTexture]) -> Self:
        """The material with other textures in these fields."""
        return dataclasses.replace(self, **changes) if changes else self

    def moved(self, offset: Vector) -> Self:
        """The material of an object that was moved by so many metres: patterns carved from space come along."""
        return self.with_fields(
            {
                name: dataclasses.replace(value, origin=tuple(a + b for a, b in zip(value.origin, offset, strict=True)))
                for name, value in self.solids().items()
            }
        )


def rgb(color: Color) -> Plugin:
    """A colour as Mitsuba takes it."""
    return {"type": "rgb", "value": [float(value) for value in color]}
