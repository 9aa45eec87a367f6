"""Lamps of a foreign file as lights of ours: suns in the sky, and squares that shine on the scene.

A lamp of a file has no size. Light from a point never comes through smooth glass but by chance, so each lamp gets the
size of a small window, and gives as much light at the scene's middle as it did.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from datagen.disk.errors import HyalineError
from datagen.scene.importers.foreign import ForeignLamp
from datagen.scene.importers.remarks import Remarks
from datagen.scene.lights import Lobe, RectangleLight, SoftEnvironment
from datagen.scene.values import Color, as_vector

IRRADIANCE = 2.5
"""Of all lamps together at the scene's middle. Files have candela and lux, which viewers expose as they like."""
SIDE = 0.15
"""Of a square over its distance from the scene's middle: as wide as 9 degrees."""
SHARPNESS = 400.0
"""Of a sun: as wide as 7 degrees at half of its height."""
FILL = 0.4
"""Share of the soft light between the cards that stays."""


def lit(
    lamps: Sequence[ForeignLamp],
    soft: SoftEnvironment,
    linear: Float[np.ndarray, "3 3"],
    offset: Float[np.ndarray, "3"],
    middle: Float[np.ndarray, "3"],
    remarks: Remarks,
) -> tuple[SoftEnvironment, tuple[RectangleLight, ...]]:
    """The sky and the squares that stand for lamps.

    Args:
        soft: the light of which a share stays, but for its cards.
        linear: with `offset`, from the file's world to ours.
        middle: of the scene, in our world.

    Raises:
        HyalineError: no lamp shines on the scene.
    """
    target = np.linalg.solve(linear, middle - offset)
    given = [(lamp, _irradiance(lamp, target)) for lamp in lamps]
    total = sum(sum(light) / 3 for _, light in given)
    if total <= 0:
        raise HyalineError("--lights file: the file brings no lamp that shines on the scene; leave it out")
    remarks.approximate(
        "lamps", f"their strength, {total:.3g} at the scene's middle, is set to {IRRADIANCE:g}, as by an exposure"
    )
    lobes, squares = [], []
    for lamp, light in given:
        if max(light) <= 0:
            remarks.note(lamp.name, "is a lamp that does not shine on the scene's middle; left out")
            continue
        scale = IRRADIANCE / total
        remarks.approximate(lamp.name, f"is a {lamp.kind} lamp without a size; drawn some degrees wide")
        if lamp.kind == "directional":
            # The integral of exp(s (cos - 1)) over the sphere is 2 pi / s.
            radiance = _times(light, scale * SHARPNESS / (2 * math.pi))
            lobes.append(Lobe(direction=as_vector(-(linear @ lamp.direction)), radiance=radiance, sharpness=SHARPNESS))
        else:
            place = linear @ lamp.position + offset
            squares.append(_square(place, middle, _times(light, scale / SIDE**2)))
    sky = dataclasses.replace(
        soft,
        zenith=_times(soft.zenith, FILL),
        horizon=_times(soft.horizon, FILL),
        ground=_times(soft.ground, FILL),
        lobes=tuple(lobes),
        cards=(),
    )
    return sky, tuple(squares)


def _irradiance(lamp: ForeignLamp, target: Float[np.ndarray, "3"]) -> Color:
    """What a lamp gives at a place in the file's world, on what faces it."""
    if lamp.kind == "directional":
        return lamp.intensity
    way = target - lamp.position
    distance = float(np.linalg.norm(way))
    if distance <= 0 or float(way @ lamp.direction) < math.cos(min(lamp.cone, math.pi)) * distance - 1e-9:
        return 0.0, 0.0, 0.0
    return _times(lamp.intensity, 1 / distance**2)


def _square(place: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], radiance: Color) -> RectangleLight:
    """A square around a place, which shines on a target."""
    way = target - place
    distance = float(np.linalg.norm(way))
    ahead = way / distance
    u = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    u /= np.linalg.norm(u)
    v = np.cross(ahead, u)
    side = SIDE * distance
    return RectangleLight(
        corner=as_vector(place - side * (u + v) / 2),
        edge_u=as_vector(side * u),
        edge_v=as_vector(side * v),
        radiance=radiance,
    )


def _times(color: Color, factor: float) -> Color:
    red, green, blue = (factor * c for c in color)
    return red, green, blue
