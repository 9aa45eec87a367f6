"""Light on a foreign scene: what the file brings as lights of ours, or soft light where it brings none.

A lamp of a file has no size. Light from a point never comes through smooth glass but by chance, so each lamp gets the
size of a small window, and gives as much light at the scene's middle as it did.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from datagen.disk.errors import HyalineError
from datagen.scene.description import Card, EnvironmentMap, Lobe, RectangleLight, SoftEnvironment
from datagen.scene.importers.foreign import ForeignLamp, ForeignLight, ForeignMap
from datagen.scene.importers.remarks import Remarks
from datagen.scene.values import Color, Vector, as_vector

DUST = 1e-9
"""Of an edge's largest coordinate: what rounding leaves of a turn."""
UPRIGHT = 0.9999
"""Cosine of the angle by which a map of the environment may lean."""
IRRADIANCE = 2.5
"""Of all lamps together at the scene's middle. Files have candela and lux, which viewers expose as they like."""
SIDE = 0.15
"""Of a square over its distance from the scene's middle: as wide as 9 degrees."""
SHARPNESS = 400.0
"""Of a sun: as wide as 7 degrees at half of its height."""
FILL = 0.4
"""Share of the soft light between the cards that stays."""


def towards(azimuth_deg: float, elevation_deg: float) -> Vector:
    """The unit direction at an azimuth and an elevation."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    across = math.cos(elevation)
    return across * math.cos(azimuth), across * math.sin(azimuth), math.sin(elevation)


LIGHT = SoftEnvironment(
    zenith=(0.34, 0.38, 0.45),
    horizon=(0.50, 0.47, 0.44),
    ground=(0.20, 0.18, 0.17),
    cards=(
        # Flags stand low between the softboxes: they draw the dark outline of glass from wherever one looks.
        Card(direction=towards(-55, 12), size_deg=(26.0, 64.0), radiance=(0.06, 0.06, 0.07), softness_deg=10.0),
        Card(direction=towards(65, 12), size_deg=(26.0, 64.0), radiance=(0.06, 0.06, 0.07), softness_deg=10.0),
        Card(direction=towards(185, 12), size_deg=(26.0, 64.0), radiance=(0.06, 0.06, 0.07), softness_deg=10.0),
        # The key, warm; a cool one across, and one behind that looks like a window.
        Card(direction=towards(-20, 42), size_deg=(23.0, 64.0), radiance=(6.0, 5.3, 4.4), softness_deg=3.0),
        Card(direction=towards(-140, 26), size_deg=(26.0, 52.0), radiance=(1.7, 2.1, 2.7), softness_deg=3.0),
        Card(direction=towards(110, 30), size_deg=(40.0, 40.0), radiance=(2.5, 2.5, 2.5), softness_deg=3.0),
        Card(direction=towards(0, 90), size_deg=(50.0, 30.0), radiance=(2.2, 2.2, 2.2), softness_deg=6.0),
    ),
)
"""Softboxes and flags all around, as photographers show glass: bright cards draw highlights on it and caustics below
it, dark ones its outline. All are wide enough to be found by chance, so that pictures need few samples."""


def even_sky(radiance: Color) -> SoftEnvironment:
    """The same light from all around."""
    return SoftEnvironment(zenith=radiance, horizon=radiance, ground=radiance)


def placed_light(
    light: ForeignLight, linear: Float[np.ndarray, "3 3"], offset: Float[np.ndarray, "3"]
) -> RectangleLight:
    """A light of the file in our world."""
    return RectangleLight(
        corner=as_vector(linear @ light.corner + offset),
        edge_u=as_vector(_without_dust(linear @ light.edge_u)),
        edge_v=as_vector(_without_dust(linear @ light.edge_v)),
        radiance=light.radiance,
    )


def _without_dust(edge: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The edge without what rounding left of a turn: Mitsuba 3.9 makes radiance of 2e-16 m that is no number."""
    return np.where(np.abs(edge) < DUST * np.abs(edge).max(), 0.0, edge)


def placed_map(sky: ForeignMap, linear: Float[np.ndarray, "3 3"], remarks: Remarks) -> EnvironmentMap:
    """A map of the environment in our world; one that does not stand upright there is set up."""
    middle, up = (linear @ sky.middle, linear @ sky.up)
    if up[2] < UPRIGHT * np.linalg.norm(up):
        remarks.approximate("environment", "is tilted; drawn upright, turned about the vertical alone")
    return EnvironmentMap(
        path=f"textures/environment{sky.ending}",
        scale=sky.scale,
        rotation_deg=math.degrees(math.atan2(middle[1], middle[0])),
    )


# Lamps


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
