"""Numbers in a scene's description: vectors, colours, and their checks."""

import math

import numpy as np
from jaxtyping import Float

from datagen.disk.errors import HyalineError

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


def check_roughness(roughness: float) -> None:
    """Checks that a microfacet alpha is in the range of Mitsuba's sampling."""
    if not 0.001 <= roughness <= 1:
        raise HyalineError(f"roughness: is {roughness}; expected 0.001 to 1")
