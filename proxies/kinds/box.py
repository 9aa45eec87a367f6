"""Proxies of kind `box`: the oriented bounding box of least volume."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from datagen.data.meshes import Mesh, mesh_from, normals_of
from datagen.scene.modelling import grid_faces
from proxies.solid import Solid

MAX_DIRECTIONS = 400
"""Face normals of the hull to try as a side of the box, largest area first."""

CELLS = 8
"""Cells along the box's longest side; shorter sides have fewer, so that cells are almost square."""

MAX_EDGES = 20
"""Hull edges to try in pairs as flush with two neighbouring sides of the box, longest first."""

WORTH_TURNING = 5e-3
"""Least gain in volume for a box that is not aligned with the world's axes."""

GUTTER = 1.25 / 256
"""Distance of a chart from its slot's rim: 2.5 texels between charts at 256^2, so bilinear lookups never mix two."""

MIN_ROW = 1 / 16
"""Least height of a row of charts, relative to the atlas, so that the thin sides of a slab keep some texels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Box:
    """An oriented box."""

    center: Float64[np.ndarray, "3"]
    axes: Float64[np.ndarray, "3 3"]
    """Unit axes as rows, right-handed, longest side first."""
    half: Float64[np.ndarray, "3"]
    """Half of each side in metres."""


def fit_box(solid: Solid, *, padding: float) -> Mesh:
    """The solid's smallest oriented box, each side moved outward by `padding` metres."""
    box = smallest_box(solid)
    return box_mesh(Box(center=box.center, axes=box.axes, half=box.half + padding))


def smallest_box(solid: Solid) -> Box:
    """The oriented box of least volume around all points.

    The smallest box need not be flush with a face of the hull (O'Rourke 1985), so the best flush ones only start a
    descent: the box is rotated about each of its axes in turn to the exact optimum, until nothing improves.
    """
    points = solid.hull_points
    frames = [np.eye(3), *(_turned_about(direction, points) for direction in _directions(solid))]
    volumes = np.array([_volume(frame, points) for frame in frames])
    # For round objects all directions are equal: a rotated box must be clearly better than the upright one.
    best, least = frames[0], volumes[0] * (1 - WORTH_TURNING)
    for index in np.argsort(volumes, kind="stable")[:5]:
        frame, volume = frames[index], volumes[index]
        for _ in range(20):
            turned = min(
                (_turned_about(axis, points) for axis in frame), key=lambda candidate: _volume(candidate, points)
            )
            if _volume(turned, points) > volume * (1 - 1e-7):
                break
            frame, volume = turned, _volume(turned, points)
        if volume < least * (1 - 1e-6):
            least = volume
            best = frame
    return _box_of_frame(best, solid.points)


def box_mesh(box: Box) -> Mesh:
    """The box as a closed mesh: a grid on each of the six sides, each side a chart of its own, flat normals."""
    counts = np.clip(np.ceil(CELLS * box.half / box.half.max()), 1, CELLS).astype(int)
    # Heights of the three rows of charts, relative to the atlas, by their vertical sides.
    heights = np.maximum(box.half[[1, 2, 2]] / box.half[[1, 2, 2]].sum(), MIN_ROW)
    heights = heights / heights.sum()
    vertices, faces, normals, uv = [], [], [], []
    total = 0
    # Each row of the atlas holds the two sides across one axis: (u axis, v axis, normal axis), widest row first.
    for row, (along_u, along_v, across) in enumerate(((0, 1, 2), (0, 2, 1), (1, 2, 0))):
        for side, sign in enumerate((1, -1)):
            # u x v must be the outward normal, or the texture would be mirrored.
            handedness = sign * np.linalg.det(np.eye(3)[[along_u, along_v, across]])
            s, t = (np.arange(counts[axis] + 1) / counts[axis] for axis in (along_u, along_v))
            s, t = (grid.reshape(-1) for grid in np.meshgrid(s, t, indexing="ij"))
            local = np.empty((len(s), 3))
            local[:, along_u] = (2 * s - 1 if handedness > 0 else 1 - 2 * s) * box.half[along_u]
            local[:, along_v] = (2 * t - 1) * box.half[along_v]
            local[:, across] = sign * box.half[across]
            low = np.array([0.5 * side, heights[:row].sum()]) + GUTTER
            high = np.array([0.5 * (side + 1), heights[: row + 1].sum()]) - GUTTER
            vertices.append(_to_world(box, local))
            normals.append(np.broadcast_to(sign * box.axes[across], local.shape))
            uv.append(low + np.stack([s, t], axis=-1) * (high - low))
            faces.append(total + grid_faces(int(counts[along_u]) + 1, int(counts[along_v]) + 1))
            total += len(s)
    within = np.clip(np.concatenate(uv), 0, 1)
    return mesh_from(np.concatenate(vertices), np.concatenate(faces), np.concatenate(normals), within)


def _directions(solid: Solid) -> np.ndarray:
    """Candidate normals (n, 3) of a side: normals of hull faces, and of planes along two hull edges."""
    corners = solid.hull_points[solid.hull_faces]
    normals = _largest(normals_of(corners), MAX_DIRECTIONS)
    edges = _largest((np.roll(corners, -1, axis=1) - corners).reshape(-1, 3), MAX_EDGES)
    one, other = np.triu_indices(len(edges), k=1)
    return np.concatenate([normals, _largest(np.cross(edges[one], edges[other]), MAX_DIRECTIONS)])


def _largest(vectors: np.ndarray, count: int) -> np.ndarray:
    """The longest vectors made unit, nearly equal and opposite ones once."""
    lengths = np.linalg.norm(vectors, axis=-1)
    order = np.argsort(-lengths, kind="stable")
    order = order[lengths[order] > 1e-6 * lengths.max(initial=0)]
    units = vectors[order] / lengths[order, None]
    # Opposite vectors count once, with a positive largest component.
    signs = np.sign(np.take_along_axis(units, np.abs(units).argmax(axis=1)[:, None], axis=1))
    _, first = np.unique(np.round(units * signs, 3), axis=0, return_index=True)
    return units[np.sort(first)][:count]


def _turned_about(axis: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The frame (3, 3) with the row `axis` and the smallest box: its base is flush with a hull edge."""
    from scipy.spatial import ConvexHull

    seed = np.eye(3)[np.abs(axis).argmin()]
    side = np.cross(axis, seed)
    side /= np.linalg.norm(side)
    base = np.stack([side, np.cross(axis, side)])
    flat = points @ base.T
    outline = flat[ConvexHull(flat, qhull_options="QJ").vertices]
    edges = np.roll(outline, -1, axis=0) - outline
    lengths = np.linalg.norm(edges, axis=-1)
    edges = edges[lengths > 1e-9 * lengths.max()] / lengths[lengths > 1e-9 * lengths.max(), None]
    across = np.stack([-edges[:, 1], edges[:, 0]], axis=-1)
    areas = np.ptp(outline @ edges.T, axis=0) * np.ptp(outline @ across.T, axis=0)
    best = int(areas.argmin())
    return np.stack([edges[best] @ base, across[best] @ base, axis])


def _volume(frame: np.ndarray, points: np.ndarray) -> float:
    return float(np.prod(np.ptp(points @ frame.T, axis=0)))


def _box_of_frame(frame: np.ndarray, points: np.ndarray) -> Box:
    """The box in a frame, its axes in a fixed order and sense whatever the search gave."""
    sizes = np.ptp(points @ frame.T, axis=0)
    # Equal sides (to rounding) are ordered by the world axis that they are nearest to.
    nearest = np.abs(frame).argmax(axis=1)
    axes = frame[np.lexsort((nearest, -np.round(sizes / sizes.max(), 6)))]
    for axis in axes[:2]:
        axis *= np.sign(axis[np.abs(axis).argmax()])
    axes[2] = np.cross(axes[0], axes[1])
    local = points @ axes.T
    low, high = local.min(axis=0), local.max(axis=0)
    return Box(center=0.5 * (low + high) @ axes, axes=axes, half=0.5 * (high - low))


def _to_world(box: Box, local: np.ndarray) -> np.ndarray:
    """Element by element, not by matrix product: BLAS rounds equal rows differently, and seams would open."""
    x, y, z = (local[:, axis, None] for axis in range(3))
    return box.center + x * box.axes[0] + y * box.axes[1] + z * box.axes[2]
