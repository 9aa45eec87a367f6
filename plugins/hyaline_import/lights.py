"""The lamps and skies of foreign files in a scene of ours."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from datagen.data.meshes import Mesh, face_corners, open_edges
from datagen.scene.description import EnvironmentMap, RectangleLight, SceneObject
from datagen.scene.materials import Color, as_vector
from datagen.scene.rig import subject_box
from hyaline_import.foreign import ForeignLight, ForeignMap
from hyaline_import.remarks import Remarks
from hyaline_import.staging import is_enclosed

DUST = 1e-9
"""Rounding error of a rotation, as a share of an edge's largest coordinate."""
UPRIGHT = 0.9999
"""Cosine of the largest tilt of an environment map that is ignored."""
IRRADIANCE = 2.5
"""Irradiance of all lamps together at the middle of a scene that they alone light; viewers expose freely."""
LEAST_GLOW = 0.5
"""Radiance from which a surface is a lamp; below, it is a surface that glows a little."""
LEAST_SIDE = 0.02
"""Share of a lamp's box below which a side is left out."""


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
    """The edge without rounding errors of a rotation: Mitsuba 3.9 returns NaN for an edge of 2e-16 m."""
    return np.where(np.abs(edge) < DUST * np.abs(edge).max(), 0.0, edge)


def placed_map(sky: ForeignMap, linear: Float[np.ndarray, "3 3"], remarks: Remarks) -> EnvironmentMap:
    """A map of the environment in our world; a tilted one is drawn upright."""
    middle, up = (linear @ sky.middle, linear @ sky.up)
    if up[2] < UPRIGHT * np.linalg.norm(up):
        remarks.approximate("environment", "is tilted; drawn upright, turned about the vertical alone")
    return EnvironmentMap(
        path=f"textures/environment{sky.ending}",
        scale=sky.scale,
        rotation_deg=math.degrees(math.atan2(middle[1], middle[0])),
    )


# Surfaces that emit light


def glowing(mesh: Mesh, radiance: Color) -> tuple[RectangleLight, ...]:
    """Rectangles with the power of a surface that emits light: the sides of a box around a closed one, or one in the
    middle of an open one, which shines to where its faces look."""
    corners = face_corners(mesh).astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    points = mesh.vertices.astype(np.float64)
    frames = (np.eye(3), np.linalg.eigh(across.T @ (across / np.linalg.norm(across, axis=1, keepdims=True)))[1].T)
    frame = min(frames, key=lambda rows: float(np.prod(np.ptp(points @ rows.T, axis=0) + 1e-6)))
    low, high = (points @ frame.T).min(axis=0), (points @ frame.T).max(axis=0)
    middle, size = (low + high) / 2 @ frame, high - low
    sides = [(axis, sign) for axis in range(3) for sign in (-1.0, 1.0)]
    if open_edges(mesh):
        axis = int(size.argmin())
        sides, size[axis] = [(axis, float(np.sign(across.sum(axis=0) @ frame[axis]) or 1.0))], 0.0
    areas = {side: float(np.prod(np.delete(size, side[0]))) for side in sides}
    sides = [side for side in sides if areas[side] > LEAST_SIDE * sum(areas.values())]
    scale = float(np.linalg.norm(across, axis=1).sum()) / sum(areas[side] for side in sides)
    found = []
    for axis, sign in sides:
        u, v = (size[other] * frame[other] for other in np.delete(np.arange(3), axis))
        if np.cross(u, v) @ frame[axis] * sign < 0:
            u, v = v, u
        corner = middle + sign * size[axis] / 2 * frame[axis] - (u + v) / 2
        found.append(
            RectangleLight(
                corner=as_vector(corner), edge_u=as_vector(u), edge_v=as_vector(v), radiance=_times(radiance, scale)
            )
        )
    return tuple(found)


def exposed(
    lights: tuple[RectangleLight, ...], objects: Sequence[SceneObject], remarks: Remarks
) -> tuple[RectangleLight, ...]:
    """The lights as a camera exposes them: where walls keep out the sky, they alone light the scene's middle."""
    middle = subject_box(objects).mean(axis=0)
    if not lights or not is_enclosed(objects, middle):
        return lights
    total = 0.0
    for light in lights:
        u, v = np.array(light.edge_u), np.array(light.edge_v)
        way = middle - light.corner - (u + v) / 2
        total += max(float(np.cross(u, v) @ way), 0.0) / float(np.linalg.norm(way)) ** 3 * sum(light.radiance) / 3
    if total <= 0:
        return lights
    remarks.approximate(
        "lamps", f"their strength, {total:.3g} at the scene's middle, is set to {IRRADIANCE:g}, as by an exposure"
    )
    return tuple(dataclasses.replace(light, radiance=_times(light.radiance, IRRADIANCE / total)) for light in lights)


def _times(color: Color, factor: float) -> Color:
    red, green, blue = (factor * c for c in color)
    return red, green, blue
