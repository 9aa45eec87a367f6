"""Depth maps of opaque surfaces, from pictures whose cameras are known, and the surfaces fused from them.

Depths, by plane sweeping (Collins 1996): each view's surroundings are compared with other views as if they lay on
planes at many depths, by normalised cross-correlation, which a change of brightness leaves as it is. Small pictures try
all depths, larger ones some near those of the smaller (Gu et al. 2020). Glass is left out, and so are depths that other
views deny. Surfaces, after Curless and Levoy 1996: a signed distance in voxels, averaged
over views. Only what views show has a surface; meshes are open behind.
"""

# Numba's decorators are untyped.
# pyright: reportMissingTypeStubs=false

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numba
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from datagen.data.cameras import Cameras
from datagen.data.meshes import Mesh, mesh_from
from datagen.disk.errors import HyalineError
from datagen.machine.compiled import compiled
from datagen.machine.processes import num_cores
from datagen.scene.atlas import faces_apart, find_arrays, keep_arrays, key_of, unwrap
from datagen.terminal.command import say, track

PLANES = 192
"""Depths that are tried in the smallest pictures, evenly spaced in 1 / depth."""
SMALLEST = 220
"""Pictures are halved until their longer side is at most this many pixels."""
NEARBY = 4
"""Depths that larger pictures try on either side of what is known, at steps halved as often as pixels."""
SOURCES = 6
"""Other views that a view is compared with; the best half of them counts, since some see it hidden."""
ANGLE_DEG, ANGLES_DEG = 15.0, (4.0, 35.0)
"""Best angle between a view and those it is compared with, and its limits."""
HALF_WINDOW = 2
"""Pixels on either side of the one that is compared; things seem wider than they are by about as much."""
LEAST_SCORE = 0.6
"""Mean cross-correlation of a depth that is kept."""
LEAST_CONTRAST = 0.006
"""Standard deviation of brightness (of 1) in a window, below which noise decides."""
AGREE, LEAST_AGREEING = 0.02, 2
"""Relative tolerance within which other views must find the same depth, and how many must."""
MOST_POINTS = 60_000
MOST_VOXELS = 8e6
MOST_FACES = 40_000
"""Faces of all surfaces; voxels become larger until there are no more. With 60,000, a room of photographs has 0.5 dB
more than with 20,000, but xatlas takes 3 CPU seconds for a piece of 10,000 and 35 for one of 40,000."""
TRUNCATION = 3.0
"""Distance in voxels up to which a depth says anything about what is behind it."""
LEAST_VIEWS = 3.0
"""Views that must have seen a voxel."""
SMOOTHING = 1.0
"""Standard deviation in voxels of the Gaussian filter that smooths distances."""
LEAST_AREA = 60.0
"""Area of the smallest piece that is kept, in squares of a voxel's side; smaller ones are errors of depth maps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthMaps:
    """Depths along the cameras' axes in metres; 0 where none was found.

    What is seen through a pane appears a third of the pane's thickness nearer than it is. That is less than a depth is
    off by, and is left as it is.
    """

    cameras: Cameras
    depth: Float32[np.ndarray, "view h w"]

    def points(self, cell: float) -> Float[np.ndarray, "point 3"]:
        """Some of the points that the maps show, at most one in each cubic cell: near and far surfaces count alike."""
        views, rows, columns = np.nonzero(self.depth)
        some = np.random.default_rng(0).permutation(len(views))[:MOST_POINTS]
        view, row, column = views[some], rows[some], columns[some]
        linear, shift = np.split(projections_of(self.cameras)[view], [3], axis=2)
        ahead = self.depth[view, row, column, None] * np.stack([column + 0.5, row + 0.5, np.ones(len(some))], axis=1)
        points = np.linalg.solve(linear, ahead[..., None] - shift)[..., 0]
        return points[np.unique(np.floor(points / cell), axis=0, return_index=True)[1]]


def find_depths(
    pictures: Sequence[UInt8[np.ndarray, "h w 3"]],
    is_glass: Sequence[Bool[np.ndarray, "h w"]],
    cameras: Cameras,
    middle: Float[np.ndarray, "3"],
    borders: tuple[float, float],
) -> DepthMaps:
    """The depth map of each view; what an earlier call found of the same views is kept.

    Args:
        is_glass: True where a picture shows glass that shifts what is seen through it: any but panes.
        middle: a point that most cameras see.
        borders: the least and the largest depth.
    """
    grey = np.stack([picture.astype(np.float32).mean(axis=-1) / 255 for picture in pictures])
    sources = sources_of(cameras, middle)
    opaque, (near, far) = np.logical_not(np.stack(is_glass)), borders
    depth, _ = _depths(grey, opaque, projections_of(cameras), sources, 1 / near, 1 / far)
    return DepthMaps(cameras=cameras, depth=depth)


def _depths(
    grey: Float32[np.ndarray, "view h w"],
    opaque: Bool[np.ndarray, "view h w"],
    projections: Float[np.ndarray, "view 3 4"],
    sources: Sequence[Int[np.ndarray, " _"]],
    most: float,
    least: float,
) -> tuple[Float32[np.ndarray, "view h w"], float]:
    """Depths, of which the inverse is between the least and the most, and the step of the inverse."""
    from skimage.measure import block_reduce

    known = np.zeros_like(grey)
    if max(grey.shape[1:]) <= SMALLEST:
        step = (most - least) / (PLANES - 1)
        first, offsets = np.full(grey.shape, least, np.float32), step * np.arange(PLANES)
    else:
        block, half = cast(int, (1, 2, 2)), np.diag([0.5, 0.5, 1.0])
        smaller = block_reduce(grey, block, np.mean), block_reduce(opaque, block, np.all)
        coarse, step = _depths(*smaller, half @ projections, sources, most, least)
        known = coarse.repeat(2, axis=1).repeat(2, axis=2)[:, : grey.shape[1], : grey.shape[2]] * opaque
        first, step = np.stack([_inverse(each) for each in known]), step / 2
        offsets = step * np.arange(-NEARBY, NEARBY + 1)

    def sweep(view: int) -> Float32[np.ndarray, "h w"]:
        others = sources[view]
        turn, shift = _between(projections, view, others)
        given = (grey[view], opaque[view], grey[others], opaque[others], turn, shift, first[view])
        arrays = (*given, offsets.astype(np.float32))
        key = key_of({str(place): part for place, part in enumerate(arrays)}, [Path(__file__)])
        if not (kept := find_arrays("depths", [key])):
            kept = {key: {"depth": _sweep(*arrays)}}
            keep_arrays("depths", kept)
        return kept[key]["depth"]

    def agreed(view: int) -> Float32[np.ndarray, "h w"]:
        others = sources[view]
        return _agreed(depth[view], depth[others], *_between(projections, view, others))

    with ThreadPoolExecutor(num_cores()) as pool:  # Compiled code lets go of Python's lock.
        count, label = len(grey), f"depth maps, {grey.shape[2]} pixels wide"
        depth = np.stack(list(track(pool.map(sweep, range(count)), label=label, total=count)))
        found = np.stack(list(pool.map(agreed, range(count))))
    return np.where(found > 0, found, known), step  # Plain surfaces show enough in small pictures alone.


def _inverse(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """1 / depth; where none is known, that of the nearest pixel which has one."""
    from scipy.ndimage import distance_transform_edt

    if not depth.any():
        return np.ones_like(depth)
    nearest = np.asarray(distance_transform_edt(depth == 0, return_distances=False, return_indices=True))
    return 1 / depth[nearest[0], nearest[1]]


def sources_of(cameras: Cameras, middle: Float[np.ndarray, "3"]) -> list[Int[np.ndarray, " _"]]:
    """For each view those that see the scene's middle from about `ANGLE_DEG` beside it."""
    away = cameras.world_from_camera[:, :3, 3] - middle
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    found = []
    for angle in np.degrees(np.arccos(np.clip(away @ away.T, -1, 1))):
        order = np.argsort(np.abs(angle - ANGLE_DEG), kind="stable")
        found.append(order[(angle[order] > ANGLES_DEG[0]) & (angle[order] < ANGLES_DEG[1])][:SOURCES])
    return found


def projections_of(cameras: Cameras) -> Float[np.ndarray, "view 3 4"]:
    """From the world to pixels times depth, rows downwards."""
    world = cameras.world_from_camera
    turn = np.diag([1.0, -1.0, -1.0]) @ world[:, :3, :3].transpose(0, 2, 1)
    linear = cameras.intrinsics @ turn
    return np.concatenate([linear, -linear @ world[:, :3, 3:]], axis=2)


def _between(
    projections: Float[np.ndarray, "view 3 4"], view: int, others: Int[np.ndarray, " source"]
) -> tuple[Float32[np.ndarray, "source 3 3"], Float32[np.ndarray, "source 3"]]:
    """A pixel (x, y, 1) of a view at a depth is seen by another at `depth * turn @ pixel + shift`, times its depth."""
    back = np.linalg.inv(projections[view, :, :3])
    turn = projections[others, :, :3] @ back
    shift = projections[others, :, 3] - turn @ projections[view, :, 3]
    return turn.astype(np.float32), shift.astype(np.float32)


@compiled(nogil=True)
def _sweep(grey, opaque, others, others_opaque, turn, shift, first, offsets):
    """Depth with the best score at each pixel, by its inverse: `first` and an offset; 0 where no score is good."""
    height, width = grey.shape
    scores = np.empty((len(offsets), height, width), np.float32)
    for plane in range(len(offsets)):
        depths = np.float32(1) / np.maximum(first + offsets[plane], np.float32(1e-6))
        best = np.full(((len(others) + 1) // 2, height, width), np.float32(-1))
        for source in range(len(others)):
            seen, weight = _warp(others[source], others_opaque[source], opaque, turn[source], shift[source], depths)
            _keep_best(best, _correlation(grey, seen, weight))
        scores[plane] = best.sum(axis=0) / max(len(best), 1)
    depth = np.zeros((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            at = scores[:, row, column].argmax()
            if not opaque[row, column] or scores[at, row, column] < LEAST_SCORE or at == 0 or at == len(offsets) - 1:
                continue
            low, mid, high = scores[at - 1, row, column], scores[at, row, column], scores[at + 1, row, column]
            bend = low - 2 * mid + high
            off = np.float32(0) if bend > -1e-6 else np.float32(0.5) * (low - high) / bend
            step = offsets[at + 1] - offsets[at]
            depth[row, column] = np.float32(1) / max(first[row, column] + offsets[at] + off * step, np.float32(1e-6))
    return depth


@numba.njit
def _warp(other, other_opaque, opaque, turn, shift, depths):
    """Another view as seen from a surface in front of this one, and 1 where it shows something opaque."""
    height, width = opaque.shape
    seen, weight = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            x, y, depth = np.float32(column + 0.5), np.float32(row + 0.5), depths[row, column]
            ahead = depth * (turn[2, 0] * x + turn[2, 1] * y + turn[2, 2]) + shift[2]
            if not opaque[row, column] or ahead <= 0:
                continue
            u = (depth * (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2]) + shift[0]) / ahead - np.float32(0.5)
            v = (depth * (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2]) + shift[1]) / ahead - np.float32(0.5)
            if not (0 <= u < width - 1 and 0 <= v < height - 1):
                continue
            left, top = int(u), int(v)
            if not other_opaque[int(v + np.float32(0.5)), int(u + np.float32(0.5))]:
                continue
            a, b = u - left, v - top
            upper = (1 - a) * other[top, left] + a * other[top, left + 1]
            lower = (1 - a) * other[top + 1, left] + a * other[top + 1, left + 1]
            seen[row, column], weight[row, column] = (1 - b) * upper + b * lower, 1
    return seen, weight


@numba.njit
def _correlation(grey, seen, weight):
    """Normalised cross-correlation of each pixel's window; -1 where less than half of it is seen, or it is plain."""
    least = np.float32((2 * HALF_WINDOW + 1) ** 2 / 2)
    flat = np.float32(LEAST_CONTRAST**2)
    count = _sums(weight)
    a, b = _sums(weight * grey), _sums(weight * seen)
    aa, bb, ab = _sums(weight * grey * grey), _sums(weight * seen * seen), _sums(weight * grey * seen)
    found = np.full(grey.shape, np.float32(-1))
    for row in range(grey.shape[0]):
        for column in range(grey.shape[1]):
            n = count[row, column]
            if n < least:
                continue
            mean_a, mean_b = a[row, column] / n, b[row, column] / n
            var_a, var_b = aa[row, column] / n - mean_a**2, bb[row, column] / n - mean_b**2
            if var_a > flat and var_b > flat:
                found[row, column] = (ab[row, column] / n - mean_a * mean_b) / np.sqrt(var_a * var_b)
    return found


@numba.njit
def _sums(values):
    """The sum over each pixel's window; 0 where that reaches beyond the border."""
    height, width = values.shape
    rows, sums = np.zeros_like(values), np.zeros_like(values)
    for row in range(height):
        for column in range(HALF_WINDOW, width - HALF_WINDOW):
            total = np.float32(0)
            for k in range(-HALF_WINDOW, HALF_WINDOW + 1):
                total += values[row, column + k]
            rows[row, column] = total
    for row in range(HALF_WINDOW, height - HALF_WINDOW):
        for k in range(-HALF_WINDOW, HALF_WINDOW + 1):
            sums[row] += rows[row + k]
    return sums


@numba.njit
def _keep_best(best, scores):
    """Keeps the best scores of each pixel, in falling order."""
    for row in range(scores.shape[0]):
        for column in range(scores.shape[1]):
            score = scores[row, column]
            for place in range(len(best)):
                if score > best[place, row, column]:
                    best[place, row, column], score = score, best[place, row, column]


def _agreed(
    depth: Float32[np.ndarray, "h w"],
    others: Float32[np.ndarray, "source h w"],
    turn: Float32[np.ndarray, "source 3 3"],
    shift: Float32[np.ndarray, "source 3"],
) -> Float32[np.ndarray, "h w"]:
    """The depths that enough other views find, too; 0 for the rest."""
    height, width = depth.shape
    rows, columns = np.indices(depth.shape, np.float32) + np.float32(0.5)
    points, agree = depth * np.stack([columns, rows, np.ones_like(rows)]), np.zeros(depth.shape, int)
    for other, t, s in zip(others, turn, shift, strict=True):
        u, v, ahead = np.tensordot(t, points, 1) + s[:, None, None]
        column, row = (np.floor(place / np.where(ahead > 0, ahead, np.inf)).astype(int) for place in (u, v))
        is_in = (ahead > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        found = other[np.where(is_in, row, 0), np.where(is_in, column, 0)]
        agree += is_in & (np.abs(found - ahead) < AGREE * ahead)
    return np.where((depth > 0) & (agree >= LEAST_AGREEING), depth, 0)


# Surfaces


def fuse(
    maps: DepthMaps,
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
    voxel: float,
    is_wanted: Callable[[Float[np.ndarray, "point 3"]], Bool[np.ndarray, " point"]],
) -> list[Mesh]:
    """The pieces of surface in a box, the largest first.

    Args:
        voxel: side in metres; larger where there would be more than `MOST_VOXELS` or `MOST_FACES`.
        is_wanted: which points of the surfaces to keep.
    """
    import trimesh
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    voxel = max(voxel, float((np.prod(high - low) / MOST_VOXELS) ** (1 / 3)))
    shape = np.ceil((high - low) / voxel).astype(int) + 1
    distance, views = _averages(maps, low, voxel, shape)
    is_seen = views >= LEAST_VIEWS
    weight = gaussian_filter(is_seen.astype(np.float32), SMOOTHING)
    distance = gaussian_filter(np.where(is_seen, distance, 0), SMOOTHING) / np.maximum(weight, 1e-6)
    if not (is_seen & (distance < 0)).any() or not (is_seen & (distance > 0)).any():
        return []
    vertices, faces, _, _ = marching_cubes(distance, 0.0, spacing=(voxel,) * 3, mask=is_seen)
    surface = trimesh.Trimesh(vertices + low, faces, process=True)
    kept = is_wanted(surface.triangles_center)
    surface.update_faces(kept & surface.nondegenerate_faces())
    if len(surface.faces) > MOST_FACES:
        return fuse(maps, low, high, 1.02 * voxel * (len(surface.faces) / MOST_FACES) ** 0.5, is_wanted)
    pieces = surface.split(only_watertight=False)
    pieces = [piece for piece in pieces if piece.area > LEAST_AREA * voxel**2]
    pieces.sort(key=lambda piece: -piece.area)
    return [mesh_from(piece.vertices, piece.faces, piece.vertex_normals) for piece in pieces]


def with_uv(mesh: Mesh, *, where: str) -> Mesh:
    """The mesh with an atlas; where unwrapping takes too long, with a chart for each face."""
    try:
        return unwrap(mesh, where=where)
    except HyalineError as error:
        say(f"{error}; each of its faces becomes a chart instead")
        return faces_apart(mesh)


def _averages(
    maps: DepthMaps, low: Float[np.ndarray, "3"], voxel: float, shape: Int[np.ndarray, "3"]
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    """Mean signed distance to the surface in units of the truncation, positive in front of it; views that saw it."""
    axes = [(start + voxel * np.arange(count)).astype(np.float32) for start, count in zip(low, shape, strict=True)]
    grid, (height, width) = np.stack(np.meshgrid(*axes, indexing="ij")), maps.depth.shape[1:]
    total, views = np.zeros(grid.shape[1:], np.float32), np.zeros(grid.shape[1:], np.float32)
    for depth, projection in zip(maps.depth, projections_of(maps.cameras).astype(np.float32), strict=True):
        u, v, ahead = np.tensordot(projection[:, :3], grid, 1) + projection[:, 3, None, None, None]
        at = (np.clip(place / np.where(ahead > 0, ahead, np.inf), -1, 1e6) for place in (u, v))
        column, row = (np.floor(place).astype(np.int32) for place in at)
        is_in = (ahead > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        found = np.where(is_in, depth[np.where(is_in, row, 0), np.where(is_in, column, 0)], 0)
        away = (found - ahead) / np.float32(TRUNCATION * voxel)
        sees = (found > 0) & (away > -1)
        total += np.where(sees, np.minimum(away, 1), 0)
        views += sees
    return total / np.maximum(views, 1), views
