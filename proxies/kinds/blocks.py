"""Proxies of kind `blocks`: a few boxes per object, such as seat, back and legs for the paper's chair.

The object is cut by a grid, with a tight box around the part in each cell, and boxes are merged in pairs where that
adds least volume. All boxes of an object are aligned with its smallest box.
"""

import numpy as np

from datagen.data.meshes import Mesh, welded
from proxies.kinds.box import smallest_box
from proxies.meshing.solid import Solid
from proxies.meshing.surface import Surface, unwrap_surfaces

MAX_BOXES = 8

GRIDS = (6, 8, 10)
"""Cells along each axis of the grids to try; the boxes that fit best are used."""

VOXELS = 40
"""Voxels along each axis of the object's box, to find its inside."""

WORTH_A_BOX = 0.03
"""An additional box must reduce the total volume by this share."""

SPREAD = 1e-4
"""Additional padding of each box of an object, relative to the diagonal, so that no sides coincide."""

CHARTED_THICKNESS = 0.05
"""Least side of a box in the atlas layout, relative to the object's diagonal."""

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
"""The sides of a box on `CORNERS`, counter-clockwise from outside: -x, +x, -y, +y, -z, +z."""


def fit_blocks(solids: tuple[Solid, ...], paddings: tuple[float, ...]) -> tuple[Mesh, ...]:
    """Up to `MAX_BOXES` closed boxes around each solid, which overlap a little where they meet."""
    return unwrap_surfaces(
        tuple(
            blocks(solid, padding=padding, step=min(paddings)) for solid, padding in zip(solids, paddings, strict=True)
        )
    )


def blocks(solid: Solid, *, padding: float, step: float) -> Surface:
    """The solid's boxes, the first larger by `padding` metres on each side, the others by at least `step` more each."""
    axes = smallest_box(solid).axes
    points = solid.points @ axes.T
    origin, size = points.min(axis=0), np.ptp(points, axis=0)
    positions, faces = welded(solid.mesh)
    local = positions.astype(np.float64) @ axes.T
    low, high = _parts((local[faces] - origin) / size)
    # Every box is thickened like the solid; otherwise flat ones would have no volume to compare.
    thickening = np.maximum(0.5 * (1 - np.ptp(local, axis=0) / size), 0)
    parts = low - thickening, high + thickening
    low, high = min((_merged(*_cell_boxes(*parts, cells)) for cells in GRIDS), key=lambda boxes: _score(*boxes))
    low, high = low * size + origin, high * size + origin
    diagonal = float(np.linalg.norm(size))
    grown = padding + max(SPREAD * diagonal, step) * np.arange(len(low))[:, None]
    return _surface(low - grown, high + grown, axes, diagonal)


def _parts(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper ends (n, 3) of small boxes that cover the surface, and its inside where it is closed."""
    small = _subdivided(corners, 1 / VOXELS)
    low, high = small.min(axis=1), small.max(axis=1)
    # A triangle smaller than a voxel touches no other voxels than those of its box's corners.
    voxels = np.zeros((VOXELS, VOXELS, VOXELS), bool)
    for corner in CORNERS:
        x, y, z = np.clip(np.where(corner, high, low) * VOXELS, 0, VOXELS - 1).astype(int).T
        voxels[x, y, z] = True
    inside = np.argwhere(_filled(voxels) & ~voxels)
    return np.concatenate([low, inside / VOXELS]), np.concatenate([high, (inside + 1) / VOXELS])


def _cell_boxes(low: np.ndarray, high: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper ends (m, 3) of a tight box around the parts with their centres in each cell."""
    cell = np.clip(0.5 * (low + high) * cells, 0, cells - 1).astype(int) @ [cells * cells, cells, 1]
    _, box = np.unique(cell, return_inverse=True)
    lower, upper = np.full((box.max() + 1, 3), np.inf), np.full((box.max() + 1, 3), -np.inf)
    np.minimum.at(lower, box, low)
    np.maximum.at(upper, box, high)
    return lower, upper


def _subdivided(corners: np.ndarray, longest: float) -> np.ndarray:
    """The triangles (face, 3, 3), bisected until no edge is longer than `longest`."""
    done = []
    while len(corners):
        lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
        is_small = lengths.max(axis=1) <= longest
        done.append(corners[is_small])
        corners, first = corners[~is_small], lengths[~is_small].argmax(axis=1)
        # The longest edge runs from a to b.
        a, b, c = (np.take_along_axis(corners, ((first + turn) % 3)[:, None, None], axis=1)[:, 0] for turn in range(3))
        middle = 0.5 * (a + b)
        corners = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(done)


def _filled(voxels: np.ndarray) -> np.ndarray:
    from scipy.ndimage import binary_fill_holes

    filled = binary_fill_holes(voxels)
    assert filled is not None
    return filled


def _merged(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The boxes merged in pairs, always the pair whose box adds least volume; largest first.

    They are merged until one is left, because for a box-shaped object one box is best, and comes after worse ones.
    """
    costs = np.stack([_added(low, high, index) for index in range(len(low))])
    alive = np.ones(len(low), bool)
    best, least = (low, high), np.inf
    while True:
        if alive.sum() <= MAX_BOXES and (score := _score(low[alive], high[alive])) < least:
            best, least = (low[alive], high[alive]), score
        if alive.sum() == 1:
            break
        one, other = (int(index) for index in np.unravel_index(int(costs.argmin()), costs.shape))
        low[one], high[one] = np.minimum(low[one], low[other]), np.maximum(high[one], high[other])
        alive[other] = False
        costs[other], costs[:, other] = np.inf, np.inf
        added = np.where(alive, _added(low, high, one), np.inf)
        costs[one], costs[:, one] = added, added
    low, high = best
    order = np.argsort(-np.prod(high - low, axis=-1), kind="stable")
    return low[order], high[order]


def _added(low: np.ndarray, high: np.ndarray, index: int) -> np.ndarray:
    """The volume (n,) added by a box around each box and the one at `index`; infinite for itself."""
    around = np.prod(np.maximum(high, high[index]) - np.minimum(low, low[index]), axis=-1)
    shared = np.prod(np.maximum(np.minimum(high, high[index]) - np.maximum(low, low[index]), 0), axis=-1)
    added = around - np.prod(high - low, axis=-1) - np.prod(high[index] - low[index]) + shared
    added[index] = np.inf
    return added


def _score(low: np.ndarray, high: np.ndarray) -> float:
    return _union_volume(low, high) * (1 + WORTH_A_BOX) ** len(low)


def _union_volume(low: np.ndarray, high: np.ndarray) -> float:
    """The volume of the union of a few boxes, on the grid of all their sides."""
    planes = [np.unique(np.concatenate([low[:, axis], high[:, axis]])) for axis in range(3)]
    middles = [0.5 * (plane[1:] + plane[:-1]) for plane in planes]
    x, y, z = ((low[:, axis, None] < middles[axis]) & (middles[axis] < high[:, axis, None]) for axis in range(3))
    is_taken = np.einsum("bi,bj,bk->ijk", x, y, z) > 0
    return float(np.einsum("ijk,i,j,k->", is_taken, *(np.diff(plane) for plane in planes)))


def _surface(low: np.ndarray, high: np.ndarray, axes: np.ndarray, diagonal: float) -> Surface:
    """Boxes (n, 3) along the axes as one surface, each side with vertices of its own for its normal."""
    count = len(low)
    corners = np.where(CORNERS, high[:, None], low[:, None])[:, QUADS].reshape(-1, 3)
    # Apart and thicker for the atlas, because xatlas would merge touching boxes.
    sizes = np.maximum(high - low, CHARTED_THICKNESS * diagonal)
    apart = np.arange(count)[:, None, None, None] * [2 * diagonal + sizes.max(), 0, 0]
    charted = (CORNERS[QUADS] * sizes[:, None, None] + apart).reshape(-1, 3)
    signs = np.repeat([-1, 1, -1, 1, -1, 1], 4)[:, None] * axes[np.repeat([0, 0, 1, 1, 2, 2], 4)]
    quads = np.arange(6 * count)[:, None, None] * 4 + [[0, 1, 2], [0, 2, 3]]
    x, y, z = (corners[:, axis, None] for axis in range(3))
    return Surface(
        # Element by element, not by matrix product: BLAS rounds equal rows differently, and seams would open.
        vertices=x * axes[0] + y * axes[1] + z * axes[2],
        faces=quads.reshape(-1, 3),
        normals=np.tile(signs, (count, 1)),
        charted=charted,
    )
