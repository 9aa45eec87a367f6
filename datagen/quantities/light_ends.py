"""Where the light of a pixel comes from, through all glass: refractive flow and attenuation.

A light path (datagen/trace/light_path.py) starts at the camera, through the pixel's centre, is refracted by every
surface of glass and ends on the first opaque surface, or leaves the scene. Rough glass counts as smooth: its facets
spread light around that path. It is traced when it is asked for.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from datagen.data.cameras import Camera
from datagen.trace.limits import Limits

if TYPE_CHECKING:
    from datagen.trace.light_path import LightPathTracer

LIMITS = Limits(max_branches=1, max_vertices=1)
"""Of one vertex, the place holds the path's last one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightEnds:
    """Where the refracted path through each pixel's centre ends. Everything is 0 where it was given up."""

    object_id: UInt8[np.ndarray, "h w"]
    """The opaque object on which it ends; 0 where it left the scene."""
    has_left: Bool[np.ndarray, "h w"]
    """It ends in the sky, or in a light."""
    position: Float32[np.ndarray, "h w 3"]
    """Where it ends, in metres, in world axes; 0 where it left."""
    depth_along_axis: Float32[np.ndarray, "h w"]
    """Metres that `position` lies ahead of the camera, along the axis; less than 0 behind it, 0 where it left."""
    distance: Float32[np.ndarray, "h w"]
    """Metres from the camera's centre straight to `position`, which is not on the pixel's ray where glass refracts it;
    0 where it left."""
    direction: Float32[np.ndarray, "h w 3"]
    """Unit direction in world axes in which it arrives there, or in which it left."""
    attenuation: Float32[np.ndarray, "h w 3"]
    """Share of the light from there, per colour channel, that reaches the camera along this path: what surfaces do not
    mirror (Fresnel) times what media do not absorb (Beer and Lambert). 1 where there is no glass."""
    flow: Float32[np.ndarray, "h w 2"]
    """Refractive flow in pixels, (right, down): pixel (x, y) shows the point, or the direction of the sky, that the
    camera sees at (x, y) + flow when nothing refracts. 0 where there is no glass."""
    has_flow: Bool[np.ndarray, "h w"]
    """False where `flow` is 0 because there is none: the path ends behind the camera, or was given up."""


def find_light_ends(camera: Camera, tracer: "LightPathTracer", is_glass: Bool[np.ndarray, " id"]) -> LightEnds:
    """Follows the ray through the centre of each pixel of a camera that stands in air.

    Args:
        is_glass: by object id.
    """
    shape = (camera.height, camera.width)
    origin, directions = camera.rays()
    rays = directions.reshape(-1, 3)
    paths = tracer.trace(np.tile(origin, (len(rays), 1)), rays, LIMITS)
    object_id, has_left = paths.object_id[0, 0].reshape(shape), paths.has_left[0].reshape(shape)
    has_ended = (object_id > 0) & ~is_glass[object_id] & ~has_left
    is_known = has_ended | has_left

    def where_known(ended: Float32[np.ndarray, "ray 3"], left: Float32[np.ndarray, "ray 3"]) -> np.ndarray:
        values = np.where(has_left[..., None], left.reshape(*shape, 3), ended.reshape(*shape, 3))
        return np.where(is_known[..., None], values, np.float32(0))

    position = np.where(has_ended[..., None], paths.position[0, 0].reshape(*shape, 3), np.float32(0))
    direction = where_known(paths.direction[0, 0], paths.end_direction[0])
    attenuation = where_known(paths.throughput[0, 0], paths.end_throughput[0])
    # A place as seen from the camera; of the sky, infinitely far, only the direction counts.
    seen = np.where(has_left[..., None], direction, position - camera.world_from_camera[:3, 3])
    flow, is_ahead = _flow(camera, seen)
    has_flow = is_known & is_ahead
    ahead = seen @ -camera.world_from_camera[:3, 2]
    return LightEnds(
        object_id=np.where(has_ended, object_id, 0).astype(np.uint8),
        has_left=has_left,
        position=position.astype(np.float32),
        depth_along_axis=np.where(has_ended, ahead, 0).astype(np.float32),
        distance=np.where(has_ended, np.linalg.norm(seen, axis=-1), 0).astype(np.float32),
        direction=direction.astype(np.float32),
        attenuation=attenuation.astype(np.float32),
        flow=np.where(has_flow[..., None], flow, 0).astype(np.float32),
        has_flow=has_flow,
    )


def _flow(camera: Camera, seen: Float[np.ndarray, "h w 3"]) -> tuple[np.ndarray, Bool[np.ndarray, "h w"]]:
    """How far from its pixel's centre (right, down) each vector from the camera is seen, and whether it is ahead."""
    d_camera = seen.astype(np.float64) @ camera.world_from_camera[:3, :3] * [1, -1, -1]
    is_ahead = d_camera[..., 2] > 1e-6
    image = d_camera @ camera.intrinsics.T
    pixels = image[..., :2] / np.where(is_ahead, image[..., 2], 1)[..., None]
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    return pixels - np.stack([columns, rows], axis=-1), is_ahead
