"""Colours of surfaces: one colour, a procedural texture, or an image."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32

from datagen.disk.errors import HyalineError
from datagen.disk.records import checked
from datagen.disk.storage import check_relative
from datagen.scene.values import Color, Vector, check_positive, check_range


@checked
@dataclass(frozen=True, kw_only=True)
class SolidTexture:
    """A procedural 3D texture, which has no seams; baked into the object's atlas."""

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


Reflectance = Color | SolidTexture | ImageTexture


def check_reflectance(color: Reflectance) -> None:
    """Checks that a colour does not exceed 1; textures check themselves."""
    if isinstance(color, tuple):
        check_range("color", color, 0, 1)


# Procedural textures. Noise is a hash of lattice points: a point has the same colour in every run and on every machine


Positions = Float[np.ndarray, "*points 3"]
Values = Float[np.ndarray, "*points"]

EDGE = 0.12
"""Width of the soft edge between two colours, in half periods: hard edges would alias when baked."""


def evaluate_texture(texture: SolidTexture, positions: Positions) -> Float32[np.ndarray, "*points 3"]:
    """Linear reflectance in [0, 1] at world positions in metres."""
    axis = "xyz".index(texture.axis)
    p_pattern = (positions.astype(np.float64) - np.array(texture.origin)) / texture.scale
    amount = PATTERNS[texture.pattern](p_pattern, axis)[..., None]
    first, second = (np.asarray(color) for color in texture.colors)
    return (first + (second - first) * np.clip(amount, 0, 1)).astype(np.float32)


# Patterns: positions in periods -> share of the second colour


def _checker(p: Positions, axis: int) -> Values:  # noqa: ARG001
    # Cells are centred on the origin, so that no axis plane lies on an edge.
    waves = _square(p[..., 0]) * _square(p[..., 1]) * _square(p[..., 2])
    return 0.5 - 0.5 * waves


def _stripes(p: Positions, axis: int) -> Values:
    return 0.5 - 0.5 * _square(p[..., axis])


def _wood(p: Positions, axis: int) -> Values:
    # Growth rings are stacked along `axis`; fibres run along another axis, where everything changes slowly.
    stretch = np.ones(3)
    stretch[1 if axis == 0 else 0] = 0.12
    along = p * stretch
    ring = p[..., axis] + 1.3 * fractal_noise(0.35 * along, octaves=2) + 0.35 * value_noise(1.1 * along + 17.0)
    phase = ring - np.floor(ring)
    # Slow from early to late wood, fast back.
    late = phase**2 * (1 - _smoothstep(0.88, 1.0, phase))
    fibre = value_noise(along * np.array([9.0, 9.0, 9.0]) + 5.0)
    return 0.8 * late + 0.35 * fibre


def _marble(p: Positions, axis: int) -> Values:  # noqa: ARG001
    warp = fractal_noise(p * 1.0, octaves=5)
    veins = 1 - np.abs(np.sin(np.pi * (p @ np.array([0.6, 0.5, 0.62]) + 2.6 * warp)))
    cloud = fractal_noise(0.7 * p + 31.0, octaves=3)
    return 0.85 * veins**5 + 0.3 * cloud**2


def _speckle(p: Positions, axis: int) -> Values:  # noqa: ARG001
    # One chip per cell, entirely inside it, so that only a point's own cell matters.
    cell = np.floor(p)
    radius = 0.16 + 0.26 * _hash(cell, 1)
    middle = np.stack([radius + (1 - 2 * radius) * _hash(cell, salt) for salt in (2, 3, 4)], axis=-1)
    distance = np.linalg.norm(p - cell - middle, axis=-1)
    return (1 - _smoothstep(0.9, 1.0, distance / radius)) * (0.35 + 0.65 * _hash(cell, 5))


PATTERNS: dict[str, Callable[[Positions, int], Values]] = {
    "checker": _checker,
    "stripes": _stripes,
    "wood": _wood,
    "marble": _marble,
    "speckle": _speckle,
}


def _square(x: Values) -> Values:
    """A square wave of period 1 between -1 and 1, +1 around 0, with soft edges."""
    # A triangle wave: 1 at 0, -1 at a half, so that the edge's width does not depend on the phase.
    triangle = 1 - 4 * np.abs(x - np.rint(x))
    return 2 * _smoothstep(-EDGE, EDGE, triangle) - 1


def _smoothstep(low: float, high: float, x: Values) -> Values:
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


# Noise


def value_noise(p: Positions) -> Values:
    """Smooth noise in [0, 1] with features of about 1."""
    cell = np.floor(p)
    t = p - cell
    t = t * t * t * (t * (6 * t - 15) + 10)
    sides = (1 - t, t)
    total = np.zeros(p.shape[:-1])
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (sides[side][..., axis] for axis, side in enumerate(corner))
        total += x * y * z * _hash(cell + np.array(corner), 0)
    return total


def fractal_noise(p: Positions, *, octaves: int) -> Values:
    """Sum of `octaves` noises, each twice as fine and half as strong, in [0, 1]."""
    total = np.zeros(p.shape[:-1])
    for octave in range(octaves):
        total += 0.5**octave * value_noise(p * 2.0**octave + 7.31 * octave)
    return total / (2 - 0.5 ** (octaves - 1))


def _hash(cell: Positions, salt: int) -> Values:
    """A number in [0, 1) for each integer point. Source: multiply-xorshift mixing as in Wang's and PCG's hashes."""
    x, y, z = (cell[..., i].astype(np.int64).astype(np.uint64) & np.uint64(0xFFFFFFFF) for i in range(3))
    mixed = x * np.uint64(0x9E3779B1) ^ y * np.uint64(0x85EBCA77) ^ z * np.uint64(0xC2B2AE3D)
    mixed = (mixed + np.uint64(salt * 0x27D4EB2F)) & np.uint64(0xFFFFFFFF)
    for multiplier in (0x7FEB352D, 0x846CA68B):
        mixed = ((mixed ^ (mixed >> np.uint64(16))) * np.uint64(multiplier)) & np.uint64(0xFFFFFFFF)
    mixed ^= mixed >> np.uint64(15)
    return mixed / 2.0**32
