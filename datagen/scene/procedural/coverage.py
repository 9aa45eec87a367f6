"""How much of the pictures is glass: triangles drawn into a few small pictures, the nearest one in each pixel.

That is what the mask `glass` of a view says, for a fiftieth of a second a view and without Mitsuba.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.data.cameras import Cameras
from datagen.data.meshes import face_corners
from datagen.scene.description import SceneObject


def glass_shares(objects: tuple[SceneObject, ...], cameras: Cameras) -> Float[np.ndarray, " view"]:
    """The share of each picture's pixels in whose middle the nearest surface is glass.

    Args:
        objects: those that are glass or can be in front of glass, in front of all cameras; what is only behind glass
            may be left out.
    """
    corners = np.concatenate([face_corners(item.mesh) for item in objects]).astype(np.float64)
    is_glass = np.repeat([item.material.is_glass for item in objects], [len(item.mesh.faces) for item in objects])
    return np.array([_seen_share(corners, is_glass, cameras, view) for view in range(len(cameras))])


def _seen_share(
    corners: Float[np.ndarray, "face 3 3"], is_glass: Bool[np.ndarray, " face"], cameras: Cameras, view: int
) -> float:
    world_from_camera = cameras.world_from_camera[view]
    seen = (corners - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    # In pixels, right and down, from the middle of the first one; depth along the axis.
    depth = -seen[..., 2]
    right = cameras.width / 2 - 0.5 + cameras.focal * seen[..., 0] / depth
    down = cameras.height / 2 - 0.5 - cameras.focal * seen[..., 1] / depth
    face, column, row = _middles_in_boxes(right, down, cameras.width, cameras.height)
    weights = _barycentric(right[face], down[face], column, row)
    inside = (weights >= 0).all(axis=-1)
    face, pixel = face[inside], (row * cameras.width + column)[inside]
    near = 1 / (weights[inside] / depth[face]).sum(axis=-1)  # Perspective: 1 / depth is linear in the picture.
    nearest = np.full(cameras.width * cameras.height, np.inf)
    np.minimum.at(nearest, pixel, near)
    is_seen = is_glass[face] & (near == nearest[pixel])
    return len(np.unique(pixel[is_seen])) / len(nearest)


def _middles_in_boxes(
    right: Float[np.ndarray, "face 3"], down: Float[np.ndarray, "face 3"], width: int, height: int
) -> tuple[Int[np.ndarray, " pair"], Int[np.ndarray, " pair"], Int[np.ndarray, " pair"]]:
    """Face, column and row of each pixel whose middle is in the box around a face; most boxes have none."""
    low_column, low_row = (np.maximum(np.ceil(x.min(axis=1)), 0).astype(np.int64) for x in (right, down))
    columns = np.minimum(np.floor(right.max(axis=1)), width - 1).astype(np.int64) - low_column + 1
    rows = np.minimum(np.floor(down.max(axis=1)), height - 1).astype(np.int64) - low_row + 1
    counts = np.maximum(columns, 0) * np.maximum(rows, 0)
    face = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    row, column = np.divmod(place, np.maximum(columns, 1)[face])
    return face, low_column[face] + column, low_row[face] + row


def _barycentric(
    right: Float[np.ndarray, "pair 3"],
    down: Float[np.ndarray, "pair 3"],
    column: Int[np.ndarray, " pair"],
    row: Int[np.ndarray, " pair"],
) -> Float[np.ndarray, "pair 3"]:
    """Weights of a face's corners at a pixel's middle; one is negative outside of the face."""
    x, y = right - column[:, None], down - row[:, None]
    # Twice the area of the triangle that the middle makes with the two corners after each.
    areas = np.stack(
        [x[:, (k + 1) % 3] * y[:, (k + 2) % 3] - x[:, (k + 2) % 3] * y[:, (k + 1) % 3] for k in range(3)], -1
    )
    total = areas.sum(axis=-1, keepdims=True)
    return np.divide(areas, total, out=np.full_like(areas, -1.0), where=total != 0)
