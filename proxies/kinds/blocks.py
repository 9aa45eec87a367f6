"""Proxies of kind `blocks`: a few boxes an object, as for the paper's chair: seat, back and legs.

The object is cut into the cells of a grid, a tight box around what lies in each, and the boxes are merged two by two
where that adds least volume. All boxes of an object stand along the axes of its smallest box.
"""

import numpy as np

from datagen.data.meshes import Mesh, welded
from proxies.kinds.box import smallest_box
from proxies.meshing.solid import Solid
from proxies.meshing.surface import Surface, unwrap_surfaces

MAX_BOXES = 8

GRIDS = (6, 8, 10)
"""Cells of a grid along each axis; of what the grids lead to, the boxes that fit best are taken."""

VOXELS = 40
"""Parts of the object's box along each axis, by which its inside is told from the outside."""

WORTH_A_BOX = 0.03
"""A box more must save this part of what they all take up."""

SPREAD = 1e-4
"""By how much more each box of an object is padded than the one before, in parts of the diagonal: no sides coincide."""

CHARTED_THICKNESS = 0.05
"""Where the atlas is laid out, no side of a box is shorter than this part of the object's diagonal."""

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
    # What the solid has been thickened by belongs to every box, or flat ones would have no volume to go by.
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
    """Lower and upper ends (m, 3) of a tight box in each cell, around the parts whose centres are in it."""
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
    """The boxes merged two by two, always the pair whose box adds least volume; largest first.

    They are merged until one is left, since what is a box itself is done best by one, which comes after worse ones.
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
    """How much volume (n,) is gained when one box is put around each and the one at `index`; infinite for itself."""
    around = np.prod(np.maximum(high, high[index]) - np.minimum(low, low[index]), axis=-1)
    shared = np.prod(np.maximum(np.minimum(high, high[index]) - np.maximum(low, low[index]), 0), axis=-1)
    added = around - np.prod(high - low, axis=-1) - np.prod(high[index] - low[index]) + shared
    added[index] = np.inf
    return added


def _score(low: np.ndarray, high: np.ndarray) -> float:
    return _union_volume(low, high) * (1 + WORTH_A_BOX) ** len(low)


def _union_volume(low: np.ndarray, high: np.ndarray) -> float:
    """What a few boxes take up together, overlaps counted once: on the grid of all their sides."""
    planes = [np.unique(np.concatenate([low[:, axis], high[:, axis]])) for axis in range(3)]
    middles = [0.5 * (plane[1:] + plane[:-1]) for plane in planes]
    x, y, z = ((low[:, axis, None] < middles[axis]) & (middles[axis] < high[:, axis, None]) for axis in range(3))
    is_taken = np.einsum("bi,bj,bk->ijk", x, y, z) > 0
    return float(np.einsum("ijk,i,j,k->", is_taken, *(np.diff(plane) for plane in planes)))


def _surface(low: np.ndarray, high: np.ndarray, axes: np.ndarray, diagonal: float) -> Surface:
    """Boxes (n, 3) along the axes as one surface, each side with vertices of its own for its normal."""
    count = len(low)
    corners = np.where(CORNERS, high[:, None], low[:, None])[:, QUADS].reshape(-1, 3)
    # Apart and thicker, for the atlas: boxes that touch would be one for xatlas.
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
