"""The radiance of a scene's sky by direction, without Mitsuba; tests and pictures compare with it."""

import numpy as np
from jaxtyping import Float

from datagen.render.mitsuba_scene import radiance_of_environment
from datagen.scene.description import Scene, SoftEnvironment, image_bytes
from datagen.scene.images import RadianceMap, bilinear, read_map


def radiance_of_sky(scene: Scene, directions: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Radiance that arrives from unit directions (world space, +z up) in a scene, without its lamps."""
    environment = scene.environment
    if isinstance(environment, SoftEnvironment):
        return radiance_of_environment(environment, directions)
    radiance = read_map(image_bytes(scene, environment), where=f"scene {scene.name}: {environment.path}")
    return radiance_of_map(radiance * np.float32(environment.scale), directions, environment.rotation_deg)


def radiance_of_map(
    radiance: RadianceMap, directions: Float[np.ndarray, "... 3"], rotation_deg: float
) -> Float[np.ndarray, "... 3"]:
    """Bilinear radiance from unit directions (world space, +z up) in a map that is turned by some degrees."""
    azimuth = np.arctan2(directions[..., 1], directions[..., 0]) - np.radians(rotation_deg)
    across = 0.5 - azimuth / (2 * np.pi)
    down = np.arccos(np.clip(directions[..., 2], -1, 1)) / np.pi
    return bilinear(radiance, across, down, wraps=(True, False))
