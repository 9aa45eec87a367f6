"""Surfaces from depth maps: a signed distance in voxels, averaged over views, and the meshes where it is zero.

Source: Curless and Levoy 1996. Only what views show has a surface; meshes are open behind.
"""

# Numba's decorators are untyped.
# pyright: reportMissingTypeStubs=false

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32

from datagen.data.meshes import Mesh
from datagen.machine.compiled import compiled
from datagen.machine.processes import num_cores
from hyaline_photos.capture.stereo import DepthMaps, projections_of

if TYPE_CHECKING:
    import trimesh

MOST_VOXELS = 8e6
TRUNCATION = 3.0
"""Distance in voxels up to which a depth says anything about what is behind it."""
LEAST_VIEWS = 3.0
"""Views that must have seen a voxel."""
SMOOTHING = 1.0
"""Standard deviation in voxels of the Gaussian filter that smooths distances."""
LEAST_AREA = 60.0
"""Area of the smallest piece that is kept, in squares of a voxel's side; smaller ones are errors of depth maps."""


def fuse(
    maps: DepthMaps,
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
    voxel: float,
    is_wanted: Callable[[Float[np.ndarray, "point 3"]], Bool[np.ndarray, " point"]],
) -> list[Mesh]:
    """The pieces of surface in a box, the largest first.

    Args:
        voxel: side in metres; larger where the box would have more than `MOST_VOXELS`.
        is_wanted: which points of the surfaces to keep.
    """
    import trimesh
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    voxel = max(voxel, float((np.prod(high - low) / MOST_VOXELS) ** (1 / 3)))
    shape = np.ceil((high - low) / voxel).astype(int) + 1
    distance, views = _averages(maps, low, voxel, tuple(shape.tolist()))
    is_seen = views >= LEAST_VIEWS
    weight = gaussian_filter(is_seen.astype(np.float32), SMOOTHING)
    distance = gaussian_filter(np.where(is_seen, distance, 0), SMOOTHING) / np.maximum(weight, 1e-6)
    if not (is_seen & (distance < 0)).any() or not (is_seen & (distance > 0)).any():
        return []
    vertices, faces, _, _ = marching_cubes(distance, 0.0, spacing=(voxel,) * 3, mask=is_seen)
    surface = trimesh.Trimesh(vertices + low, faces, process=True)
    kept = is_wanted(surface.triangles_center)
    surface.update_faces(kept & surface.nondegenerate_faces())
    pieces = surface.split(only_watertight=False)
    pieces = [piece for piece in pieces if piece.area > LEAST_AREA * voxel**2]
    return [_mesh(piece) for piece in sorted(pieces, key=lambda piece: -piece.area)]


def _mesh(piece: "trimesh.Trimesh") -> Mesh:
    return Mesh(
        vertices=piece.vertices.astype(np.float32),
        faces=piece.faces.astype(np.int32),
        normals=piece.vertex_normals.astype(np.float32),
        uv=np.zeros((len(piece.vertices), 2), np.float32),
    )


def _averages(
    maps: DepthMaps, low: Float[np.ndarray, "3"], voxel: float, shape: tuple[int, int, int]
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    """`_average` of the slices of a box, in several threads."""
    projections = projections_of(maps.cameras).astype(np.float32)

    def slice_at(place: int) -> tuple[Float32[np.ndarray, "y z"], Float32[np.ndarray, "y z"]]:
        start = np.array([low[0] + place * voxel, low[1], low[2]], np.float32)
        return _average(maps.depth, projections, start, np.float32(voxel), shape[1:])

    with ThreadPoolExecutor(num_cores()) as pool:  # Compiled code lets go of Python's lock.
        distance, views = zip(*pool.map(slice_at, range(shape[0])), strict=True)
    return np.stack(distance), np.stack(views)


@compiled(nogil=True)
def _average(depth, projections, start, voxel, shape):
    """Mean signed distance to the surface in units of the truncation, positive in front of it; views that saw it."""
    distance, views = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    height, width = depth.shape[1:]
    reach = np.float32(TRUNCATION) * voxel
    for j in range(shape[0]):
        for k in range(shape[1]):
            x, y, z = start[0], start[1] + np.float32(j) * voxel, start[2] + np.float32(k) * voxel
            total, count = np.float32(0), np.float32(0)
            for view in range(len(depth)):
                p = projections[view]
                ahead = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
                if ahead <= 0:
                    continue
                u = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / ahead
                v = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / ahead
                if not (0 <= u < width and 0 <= v < height):
                    continue
                found = depth[view, int(v), int(u)]
                if found > 0 and found - ahead > -reach:
                    total += min((found - ahead) / reach, np.float32(1))
                    count += 1
            if count > 0:
                distance[j, k], views[j, k] = total / count, count
    return distance, views
