"""What every material provides: to Mitsuba, to the tracer of light paths, and to edits."""

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
    """Index of refraction of a coat or a pane."""
    roughness: float = 0.0
    """Microfacet (GGX) alpha of a coat, a metal or solid glass; 0 is smooth."""
    color: Color = (1.0, 1.0, 1.0)
    """Share that a metal reflects, or that a pane or glass surface transmits of the light that it does not reflect."""
    texture: SolidTexture | ImageTexture | None = None
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

    def __post_init__(self) -> None:
        if not -MAX_PRIORITY <= self.priority <= MAX_PRIORITY:
            raise HyalineError(f"priority: is {self.priority}; expected {-MAX_PRIORITY} to {MAX_PRIORITY}")

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

    def textures(self) -> dict[str, SolidTexture | ImageTexture]:
        """The textures, by field name."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: value for name, value in fields.items() if isinstance(value, SolidTexture | ImageTexture)}

    def images(self) -> dict[str, ImageTexture]:
        """The image textures, by field name."""
        return {name: value for name, value in self.textures().items() if isinstance(value, ImageTexture)}

    def solids(self) -> dict[str, SolidTexture]:
        """The procedural textures, by field name."""
        return {name: value for name, value in self.textures().items() if isinstance(value, SolidTexture)}

    def with_fields(self, changes: dict[str, SolidTexture | ImageTexture]) -> Self:
        """The material with its textures in these fields replaced."""
        return dataclasses.replace(self, **changes) if changes else self

    def moved(self, offset: Vector) -> Self:
        """The material of an object moved by an offset in metres: its procedural textures move with it."""
        return self.with_fields(
            {
                name: dataclasses.replace(value, origin=tuple(a + b for a, b in zip(value.origin, offset, strict=True)))
                for name, value in self.solids().items()
            }
        )


def rgb(color: Color) -> Plugin:
    """A colour as a Mitsuba plugin."""
    return {"type": "rgb", "value": [float(value) for value in color]}
