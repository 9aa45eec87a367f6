"""Light from infinitely far: the sky's radiance by direction, and Mitsuba's map of it. Call `use_mitsuba` first."""

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32

from datagen.scene.description import Scene, image_bytes
from datagen.scene.environment_maps import look_up, read_map
from datagen.scene.lights import Card, Environment, EnvironmentMap, SoftEnvironment
from datagen.scene.materials.optics import Plugin

if TYPE_CHECKING:
    import mitsuba as mi

SMALL_LIGHT = 32.0
"""Sharpness of a lobe from which on it is aimed at. Measured on the glass table, its lobes made sharper at equal power:
to 45 dB it takes 0.8, 1.0 and 1.2 times as long without aiming at 16, 32 and 64. Shipped scenes have 4 to 8."""

SMALL_CARD_DEG = 24.0
"""Narrow side of a bright card below which it is aimed at: such a lobe is as wide at half height."""

MIN_HEIGHT, MAX_HEIGHT = 256, 2048
"""Rows of the latitude-longitude map of a soft sky, which is half as high as wide. Where it is smooth, more than 256
add nothing."""
ROWS_PER_LOBE = 4
"""Across the width at half height of the sharpest lobe."""
ROWS_PER_EDGE = 2
"""Across the edge of the sharpest card."""


def has_small_light(environment: Environment) -> bool:
    """Whether a part of the sky is so small and bright that it is worth a ray to aim at it."""
    if isinstance(environment, EnvironmentMap):
        return True  # Nearly all maps show the sun, a window or a lamp.
    is_bright = (min(card.size_deg) < SMALL_CARD_DEG and any(card.radiance) for card in environment.cards)
    return any(lobe.sharpness > SMALL_LIGHT for lobe in environment.lobes) or any(is_bright)


def radiance_of_sky(scene: Scene, directions: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Radiance that arrives from unit directions (world space, +z up) in a scene, lamps left out."""
    environment = scene.environment
    if isinstance(environment, SoftEnvironment):
        return radiance_of_environment(environment, directions)
    return look_up(_map_of(scene, environment), directions, environment.rotation_deg)


def radiance_of_environment(environment: SoftEnvironment, directions: Float[np.ndarray, "... 3"]) -> np.ndarray:
    """Radiance (..., 3) that arrives from unit directions (world space, +z up)."""
    up = directions[..., 2:3]
    sky = np.clip(up, 0, 1) ** 0.6
    ground = np.clip(-up, 0, 1) ** 0.6
    zenith, horizon, nadir = (np.array(c) for c in (environment.zenith, environment.horizon, environment.ground))
    radiance = horizon * (1 - sky - ground) + zenith * sky + nadir * ground
    for lobe in environment.lobes:
        axis = np.array(lobe.direction) / np.linalg.norm(lobe.direction)
        falloff = np.exp(lobe.sharpness * (directions @ axis - 1))[..., None]
        radiance = radiance + falloff * np.array(lobe.radiance)
    for card in environment.cards:
        cover = _cover(card, directions)[..., None]
        radiance = (1 - cover) * radiance + cover * np.array(card.radiance)
    return radiance


def _cover(card: Card, directions: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
    """How much of the sky a card hides in each direction, 0 to 1."""
    axis = np.array(card.direction) / np.linalg.norm(card.direction)
    level = np.cross(axis, (0.0, 1.0, 0.0) if abs(axis[2]) > 0.999 else (0.0, 0.0, 1.0))
    level /= np.linalg.norm(level)
    cosine, sine = math.cos(math.radians(card.roll_deg)), math.sin(math.radians(card.roll_deg))
    upright = np.cross(level, axis)
    sides = cosine * level + sine * upright, cosine * upright - sine * level
    ahead, cover = directions @ axis, 1.0
    for side, size_deg in zip(sides, card.size_deg):
        angle_deg = np.degrees(np.abs(np.arctan2(directions @ side, ahead)))
        t = np.clip((size_deg / 2 - angle_deg) / card.softness_deg + 0.5, 0, 1)
        cover = cover * t * t * (3 - 2 * t)
    return np.asarray(cover)


def environment_plugin(scene: Scene) -> Plugin:
    """Mitsuba's emitter for the light from infinitely far."""
    import mitsuba as mi

    environment = scene.environment
    if isinstance(environment, SoftEnvironment):
        radiance, to_world = painted(environment), _Z_UP
    else:
        radiance, to_world = _map_of(scene, environment), _about_z(environment.rotation_deg) @ _MIDDLE_TO_X
    return {"type": "envmap", "bitmap": mi.Bitmap(radiance), "to_world": mitsuba_transform(to_world)}


def mitsuba_transform(matrix: Float[np.ndarray, "4 4"]) -> "mi.ScalarTransform4f":
    """A matrix as Mitsuba takes it."""
    import mitsuba as mi

    return mi.ScalarTransform4f(matrix.tolist())


# Mitsuba's map has +y up: u runs with atan2(x, -z), v with acos(y).
_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""Turned about x: its y is our z."""
_MIDDLE_TO_X = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""Its middle column, towards its +z, comes to lie towards our +x."""


def _about_z(angle_deg: float) -> Float[np.ndarray, "4 4"]:
    turned = np.eye(4)
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turned[:2, :2] = [[cosine, -sine], [sine, cosine]]
    return turned


def _map_of(scene: Scene, environment: EnvironmentMap) -> Float32[np.ndarray, "h w 3"]:
    where = f"scene {scene.name}: {environment.path}"
    return read_map(image_bytes(scene, environment), where=where) * np.float32(environment.scale)


def painted(environment: SoftEnvironment) -> Float32[np.ndarray, "h w 3"]:
    """The map of a soft sky that lies as `_Z_UP` turns it."""
    height = _painted_height(environment)
    width = 2 * height
    theta = (np.arange(height) + 0.5)[:, None] / height * np.pi
    phi = (np.arange(width) + 0.5)[None, :] / width * 2 * np.pi
    x, y, z = np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta))
    return radiance_of_environment(environment, np.stack([x, -z, y], axis=-1)).astype(np.float32)


def _painted_height(environment: SoftEnvironment) -> int:
    """Rows of the map: a power of two, so many that the sharpest lobe, or edge of a card, has a few."""
    height = MIN_HEIGHT
    for lobe in environment.lobes:
        width = 2 * math.acos(max(-1.0, 1 - math.log(2) / lobe.sharpness))
        while height < MAX_HEIGHT and height * width < ROWS_PER_LOBE * math.pi:
            height *= 2
    for card in environment.cards:
        while height < MAX_HEIGHT and height * card.softness_deg < ROWS_PER_EDGE * 180:
            height *= 2
    return height
