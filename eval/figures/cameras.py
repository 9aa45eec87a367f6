"""The figure that shows where all cameras stand."""

from typing import cast

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from datagen.data.cameras import Cameras
from datagen.data.config import SPLITS, TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import true_meshes
from datagen.data.meshes import face_corners
from eval.figures.sheets import DPI, figure_png

SPLIT_COLORS: dict[Split, str] = {"train": "#2f6fdb", "interpolating": "#1a9e3c", "extrapolating": "#d62728"}
"""Blue, green and red, as in the paper's Figure 3."""
FRUSTUM_SHARE = 0.045
"""Length of a test camera's frustum over the extent of all cameras."""
MAX_FACES = 20_000
"""Triangles drawn of a scene; of more, the largest and an even selection of the others."""


def cameras_figure(dataset: Dataset, title: str) -> bytes:
    """The PNG of all cameras around the scene's meshes: in space, and seen from above."""
    cameras = {split: dataset.cameras(split) for split in SPLITS}
    faces = [face_corners(mesh).astype(np.float64) for mesh in true_meshes(dataset)]
    corners = _thinned(np.concatenate([np.zeros((0, 3, 3)), *faces]))
    places = np.concatenate([item.world_from_camera[:, :3, 3] for item in cameras.values()])
    points = np.concatenate([places, corners.reshape(-1, 3)])
    low, high = points.min(axis=0), points.max(axis=0)
    size = FRUSTUM_SHARE * float(np.max(np.ptp(places, axis=0)))

    figure = Figure(figsize=(1500 / DPI, 760 / DPI), dpi=DPI, facecolor="white")
    space = cast(Axes3D, figure.add_axes((-0.03, -0.07, 0.62, 1.1), projection="3d"))
    above = figure.add_axes((0.63, 0.09, 0.35, 0.76))
    if len(corners):
        _draw_meshes(space, above, corners)
    for split in SPLITS:
        _draw_cameras(space, above, split, cameras[split], size)
    # Cameras may all be level, and without meshes there is nothing else.
    margin = np.maximum(0.04 * (high - low), 0.01 * float((high - low).max()))
    _frame_space(space, low - margin, high + margin)
    above.set_title("from above", fontsize=11)
    above.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    above.autoscale_view()
    above.grid(color="0.92")
    above.set_axisbelow(True)
    figure.legend(loc="upper right", bbox_to_anchor=(0.99, 0.99), ncols=3, frameon=False, fontsize=11)
    figure.text(0.02, 0.95, f"{title}: cameras", fontsize=14, weight="bold")
    return figure_png(figure)


def _scaled_normals(corners: Float[np.ndarray, "face 3 3"]) -> Float[np.ndarray, "face 3"]:
    """Normals that are twice the face's area long."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _thinned(corners: Float[np.ndarray, "face 3 3"]) -> Float[np.ndarray, "kept 3 3"]:
    if len(corners) <= MAX_FACES:
        return corners
    largest_first = np.argsort(-np.linalg.norm(_scaled_normals(corners), axis=1), kind="stable")
    large, small = np.split(largest_first, [MAX_FACES // 2])
    return corners[np.concatenate([large, small[:: -(-len(small) // (MAX_FACES // 2))]])]


def _draw_meshes(space: Axes3D, above: Axes, corners: Float[np.ndarray, "face 3 3"]) -> None:
    normals = _scaled_normals(corners)
    lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-30)
    # Level faces are lighter than upright ones.
    grey = 0.5 + 0.3 * np.abs(normals[:, 2]) / lengths
    colors = np.stack([grey, grey, grey, np.full(len(grey), 0.5)], axis=1)
    space.add_collection3d(Poly3DCollection(corners, facecolors=colors, edgecolors="none", zorder=1))
    from_below = np.argsort(corners[..., 2].mean(axis=1), kind="stable")
    above.add_collection(
        PolyCollection(list(corners[from_below, :, :2]), facecolors=colors[from_below], edgecolors="none", zorder=1)
    )


def _draw_cameras(space: Axes3D, above: Axes, split: Split, cameras: Cameras, size: float) -> None:
    """Frusta, and for the test splits the path from view to view."""
    is_test = split in TEST_SPLITS
    color, alpha = SPLIT_COLORS[split], 0.95 if is_test else 0.5
    edges = frustum_edges(cameras, size if is_test else 0.6 * size)
    space.add_collection3d(Line3DCollection(edges, colors=color, linewidths=0.8, alpha=alpha, zorder=2))
    above.add_collection(LineCollection(list(edges[..., :2]), colors=color, linewidths=0.7, alpha=alpha, zorder=2))
    x, y, z = cameras.world_from_camera[:, :3, 3].T
    line = "-" if is_test else "none"
    style = {
        "color": color,
        "linestyle": line,
        "linewidth": 1.2,
        "marker": "o",
        "markersize": 3.0,
        "alpha": alpha,
        "zorder": 3,
    }
    space.plot(x, y, z, **style)
    above.plot(x, y, label=f"{split} ({len(x)})", **style)


def _frame_space(space: Axes3D, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> None:
    # matplotlib sorts whole collections by depth, so that a wall would hide the cameras in front of it.
    space.computed_zorder = False
    space.set_proj_type("persp", focal_length=1.2)
    space.view_init(elev=22, azim=-58)
    space.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    space.set_box_aspect(tuple(np.maximum(high - low, 1e-6)))
    space.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")


def frustum_edges(cameras: Cameras, size: float) -> Float[np.ndarray, "edge 2 3"]:
    """Eight line segments a camera: from its centre to the picture's corners, and around the picture.

    Args:
        size: metres from the centre to the picture.
    """
    metres = 2 * size * np.tan(cameras.fov_x / 2) / cameras.width  # Of a pixel, at the picture.
    column, row = cameras.principal_point
    left, right = -metres * column, metres * (cameras.width - column)
    low, high = -metres * (cameras.height - row), metres * row
    local = np.array([[left, low], [right, low], [right, high], [left, high]])
    p_camera = np.column_stack([local, np.full(4, -size), np.ones(4)])
    p_world = np.einsum("vij,cj->vci", cameras.world_from_camera, p_camera)[..., :3]
    center = np.broadcast_to(cameras.world_from_camera[:, None, :3, 3], p_world.shape)
    rays = np.stack([center, p_world], axis=2)
    around = np.stack([p_world, np.roll(p_world, -1, axis=1)], axis=2)
    return np.concatenate([rays, around], axis=1).reshape(-1, 2, 3)
