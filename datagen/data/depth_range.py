"""The depth range: how near and how far the surfaces in a dataset's pictures are from its cameras."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from datagen.data.cameras import Camera, Cameras
from datagen.data.config import Split
from datagen.data.meshes import Mesh, face_corners

MARGIN = 0.01
"""Near is this share nearer than the nearest surface, and far this share farther than the farthest."""

NO_SURFACE = (0.1, 10.0)
"""Near and far in metres if no picture shows a surface."""

LEAST_NEAR = 1e-6
"""Metres. A surface may pass through a camera."""


def with_depth_range(cameras: Mapping[Split, Cameras], meshes: Sequence[Mesh]) -> dict[Split, Cameras]:
    """The cameras with one near and one far for all of them, in metres along the ray.

    Every surface inside any picture lies between them, hidden surfaces included, with a margin; triangles that a
    picture shows in part count as a whole. They are rounded outwards to five digits, so that files do not depend on the
    last bit of a sum.
    """
    corners = _corners(meshes)
    found = [_depths(poses[view], corners) for poses in cameras.values() for view in range(len(poses))]
    seen = np.array([depths for depths in found if depths is not None]).reshape(-1, 2)
    near, far = NO_SURFACE
    if len(seen):
        near = max(_rounded((1 - MARGIN) * seen[:, 0].min(), up=False), LEAST_NEAR)
        far = _rounded((1 + MARGIN) * seen[:, 1].max(), up=True)
    return {split: dataclasses.replace(poses, near=near, far=far) for split, poses in cameras.items()}


def seeing(cameras: Cameras, mesh: Mesh) -> Iterator[bool]:
    """For each camera, whether its picture may show a part of a mesh, hidden or not."""
    corners = _corners([mesh])
    return (_depths(cameras[view], corners) is not None for view in range(len(cameras)))


def _corners(meshes: Sequence[Mesh]) -> Float64[np.ndarray, "face 3 3"]:
    return np.concatenate([np.zeros((0, 3, 3)), *map(face_corners, meshes)])


def _depths(camera: Camera, corners: Float64[np.ndarray, "face 3 3"]) -> tuple[float, float] | None:
    """Distances of the nearest and the farthest point of the triangles that are not beside a picture, nor behind it."""
    from trimesh.triangles import closest_point

    from_camera = corners - camera.world_from_camera[:3, 3]
    (focal, _, column), (_, _, row), _ = camera.intrinsics
    # Normals, inwards, of the planes through the camera that bound what the picture shows, in the camera's axes.
    planes = np.array(
        [
            (focal, 0, -column),
            (-focal, 0, column - camera.width),
            (0, -focal, -row),
            (0, focal, row - camera.height),
            (0, 0, -1),
        ]
    )
    is_inside = from_camera @ (camera.world_from_camera[:3, :3] @ planes.T) >= 0
    shown = from_camera[np.all(is_inside.any(axis=1), axis=1)]
    if not len(shown):
        return None
    distance = np.linalg.norm(shown, axis=2)
    longest = np.linalg.norm(shown - np.roll(shown, 1, axis=1), axis=2).max(axis=1)
    # A triangle whose corners are all farther than the nearest one by more than an edge holds no nearer point.
    close = shown[distance.min(axis=1) - longest <= distance.min()]
    nearest = np.linalg.norm(closest_point(close, np.zeros((len(close), 3))), axis=1)
    return float(min(nearest.min(), distance.min())), float(distance.max())


def _rounded(value: float, *, up: bool) -> float:
    """To five digits, away from the surfaces."""
    unit = 10.0 ** (np.floor(np.log10(max(value, LEAST_NEAR))) - 4)
    steps = np.ceil(value / unit) if up else np.floor(value / unit)
    return float(f"{steps * unit:.5g}")
