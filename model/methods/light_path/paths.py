"""Light paths of a batch of pixels, as the network takes them."""

from dataclasses import dataclass

from jaxtyping import Float32, Int, UInt8
from torch import Tensor

STACKED_VERTICES = (4, 2)
"""Vertices of the refracted and of the first mirror branch that the stack network sees."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ends:
    """The opaque vertices on which branches end."""

    ray: Int[Tensor, " end"]
    """The ray that each belongs to; a ray has as many as branches that end on a surface."""
    surface: UInt8[Tensor, " end"]
    """Whose texture it looks up: shell k of n of object i is surface (i - 1) n + k + 1. Paths meet the outermost."""
    uv: Float32[Tensor, "end 2"]
    position: Float32[Tensor, "end 3"]
    throughput: Float32[Tensor, "end 3"]
    cosine: Float32[Tensor, " end"]
    """Of the angle between the arriving ray and the surface's normal, 0 to 1."""
    reflected: Float32[Tensor, "end 3"]
    """The arriving direction, mirrored at the surface."""
    uv_slope: Float32[Tensor, "end 2"]
    """Change of uv for every metre of depth below the surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sky:
    """The branches that leave the scene."""

    ray: Int[Tensor, " exit"]
    direction: Float32[Tensor, "exit 3"]
    throughput: Float32[Tensor, "exit 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Stack:
    """The first vertices of each ray's paths, then its straight layers."""

    surface: UInt8[Tensor, "ray slot"]
    """As of `Ends`, of every shell; 0 where there is no vertex."""
    uv: Float32[Tensor, "ray slot 2"]
    throughput: Float32[Tensor, "ray slot"]
    """Mean over the colour channels."""
    cosine: Float32[Tensor, "ray slot"]
    direction: Float32[Tensor, "ray 3"]
    """Of the camera's ray."""
    position: Float32[Tensor, "ray straight 3"] | None
    """Of each straight layer; None without straight layers."""
    reflected: Float32[Tensor, "ray straight 3"] | None
    """The ray's direction, mirrored at the surface of each straight layer."""
    uv_slope: Float32[Tensor, "ray straight 2"] | None
    """Change of uv for every metre of depth below the surface of each straight layer."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPathBatch:
    """The light paths of some pixels: `samples` rays for each, pixel by pixel."""

    num_pixels: int
    samples: int
    ends: Ends
    sky: Sky
    stack: Stack | None
