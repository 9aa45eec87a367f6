"""The depth range: how near and how far the surfaces in a dataset's pictures are from its cameras."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.data.cameras import Camera, Cameras
from datagen.data.config import Split
from datagen.data.meshes import Mesh

MARGIN = 0.01
"""Near is this share nearer than the nearest surface, and far this share farther than the farthest."""

NO_SURFACE = (0.1, 10.0)
"""Near and far in metres if no picture shows a surface."""

LEAST_NEAR = 1e-6
"""Metres. A surface may pass through a camera."""

Triangles = Float[np.ndarray, "face 3 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Surfaces:
    """All triangles, laid out for looking at many cameras."""

    places: Float[np.ndarray, "3 place"]
    """Corners in world space without repeats, axis by axis."""
    corners: Int[np.ndarray, "3 face"]
    """Indices of each triangle's corners."""
    longest: Float[np.ndarray, " face"]
    """Its longest edge in metres."""

    def seen_from(
        self, origin: Float[np.ndarray, "3"], chosen: Bool[np.ndarray, " face"]
    ) -> Float[np.ndarray, "part 3 3"]:
        """Some of the triangles, as vectors from a point."""
        return np.moveaxis(self.places[:, self.corners[:, chosen]], 0, -1).swapaxes(0, 1) - origin


def with_depth_range(cameras: Mapping[Split, Cameras], meshes: Sequence[Mesh]) -> dict[Split, Cameras]:
    """The cameras with one near and one far for all of them, in metres along the ray.

    Every surface inside any picture lies between them, hidden surfaces included, with a margin. They are rounded
    outwards to five digits, so that files do not depend on the last bit of a sum.
    """
    surfaces = _lay_out(meshes)
    found = [_depths(poses[view], surfaces) for poses in cameras.values() for view in range(len(poses))]
    seen = [depths for depths in found if depths is not None]
    near, far = NO_SURFACE
    if seen:
        nearest, farthest = min(near for near, _ in seen), max(far for _, far in seen)
        near = max(_rounded((1 - MARGIN) * nearest, up=False), LEAST_NEAR)
        far = _rounded((1 + MARGIN) * farthest, up=True)
    return {split: dataclasses.replace(poses, near=near, far=far) for split, poses in cameras.items()}


def seeing(cameras: Cameras, mesh: Mesh) -> Iterator[bool]:
    """For each camera, whether its picture shows a part of a mesh, hidden or not."""
    surfaces = _lay_out([mesh])
    return (_depths(cameras[view], surfaces) is not None for view in range(len(cameras)))


def _lay_out(meshes: Sequence[Mesh]) -> _Surfaces:
    corners = np.concatenate([np.zeros((0, 3, 3)), *(mesh.vertices[mesh.faces] for mesh in meshes)])
    places, where = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return _Surfaces(
        places=np.ascontiguousarray(places.T),
        corners=np.ascontiguousarray(where.reshape(-1, 3).T),
        longest=edges.max(axis=1, initial=0),
    )


def _depths(camera: Camera, surfaces: _Surfaces) -> tuple[float, float] | None:
    """Distances of the nearest and the farthest point inside a picture; None if it shows no triangle."""
    rotation, origin = camera.world_from_camera[:3, :3], camera.world_from_camera[:3, 3]
    planes = _pyramid(camera) @ rotation.T
    height = planes @ surfaces.places - (planes @ origin)[:, None]
    outside = np.zeros(height.shape[1], np.uint8)  # A bit for each plane.
    for number, row in enumerate(height):
        outside |= (row < 0).astype(np.uint8) << number
    a, b, c = (outside[corner] for corner in surfaces.corners)
    is_kept, is_cut = (a & b & c) == 0, (a | b | c) != 0
    parts = surfaces.seen_from(origin, is_kept & is_cut)
    for plane in planes:
        parts = _clip(parts, parts @ plane)
    distance = np.linalg.norm(surfaces.places - origin[:, None], axis=0)
    seen = np.concatenate([distance[outside == 0], np.linalg.norm(parts, axis=2).ravel()])
    if not len(seen):
        return None
    # A triangle whose corners are all farther than the nearest one by more than an edge holds no nearer point.
    first, second, third = (distance[corner] for corner in surfaces.corners)
    least = np.minimum(np.minimum(first, second), third) - surfaces.longest
    close = surfaces.seen_from(origin, is_kept & ~is_cut & (least <= seen.min()))
    return min(float(seen.min()), _nearest(np.concatenate([close, parts]))), float(seen.max())


def _pyramid(camera: Camera) -> Float[np.ndarray, "plane 3"]:
    """Normals, inwards, of the planes through the camera that bound what a picture shows, in the camera's axes."""
    (focal, _, column), (_, _, row), _ = camera.intrinsics
    return np.array(
        [
            (focal, 0, -column),
            (-focal, 0, column - camera.width),
            (0, -focal, -row),
            (0, focal, row - camera.height),
            (0, 0, -1),
        ]
    )


def _clip(corners: Triangles, height: Float[np.ndarray, "face 3"]) -> Float[np.ndarray, "part 3 3"]:
    """The parts of triangles above a plane, as triangles; `height` is that of each corner, in any unit."""
    is_above = height >= 0
    count = is_above.sum(axis=1)
    parts = [corners[count == 3]]
    for number in (1, 2):
        chosen = count == number
        # The corner that is alone on its side comes first.
        first = np.argmax(is_above[chosen] if number == 1 else ~is_above[chosen], axis=1)
        order = (first[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(corners[chosen], order[..., None], axis=1), 1, 0)
        at = np.take_along_axis(height[chosen], order, axis=1)
        ab, ac = (a + (at[:, 0] / (at[:, 0] - at[:, k]))[:, None] * (end - a) for k, end in ((1, b), (2, c)))
        kept = [(a, ab, ac)] if number == 1 else [(ab, b, c), (ab, c, ac)]
        parts += [np.stack(part, axis=1) for part in kept]
    return np.concatenate(parts)


def _nearest(corners: Triangles) -> float:
    """Distance from the origin to the nearest point on the triangles' edges and inside them."""
    following = np.roll(corners, -1, axis=1)
    edges = following - corners
    length = np.maximum(np.sum(edges**2, axis=2), 1e-300)
    along = np.clip(-np.sum(corners * edges, axis=2) / length, 0, 1)
    best = float(np.linalg.norm(corners + along[..., None] * edges, axis=2).min(initial=np.inf))
    normals = np.cross(edges[:, 0], edges[:, 1])
    size = np.linalg.norm(normals, axis=1)
    foot_is_inside = _holds_foot(corners, edges, normals) & (size > 0)
    if foot_is_inside.any():
        heights = np.abs(np.sum(corners[:, 0] * normals, axis=1)[foot_is_inside]) / size[foot_is_inside]
        best = min(best, float(heights.min()))
    return best


def _holds_foot(
    corners: Triangles, edges: Triangles, normals: Float[np.ndarray, "face 3"]
) -> Bool[np.ndarray, " face"]:
    """True where the perpendicular from the origin to a triangle's plane ends inside the triangle."""
    return (np.sum(np.cross(normals[:, None], edges) * -corners, axis=2) >= 0).all(axis=1)


def _rounded(value: float, *, up: bool) -> float:
    """To five digits, away from the surfaces."""
    unit = 10.0 ** (np.floor(np.log10(max(value, LEAST_NEAR))) - 4)
    steps = np.ceil(value / unit) if up else np.floor(value / unit)
    return float(f"{steps * unit:.5g}")
