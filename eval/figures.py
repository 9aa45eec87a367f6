"""The report's PNG figures: contact sheets (truth, predictions, errors), where every pixel is a square of pixels, and
the positions of all cameras."""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from datagen.data.cameras import Cameras
from datagen.data.config import SPLITS, TEST_SPLITS, Resolution, Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import true_meshes
from datagen.data.meshes import face_corners
from datagen.data.paths import view_name
from datagen.pages.charts import names_as_they_are
from eval.score.runs import read_prediction
from eval.score.scores import RunScores, SceneScores
from eval.score.seeds import group_seeds
from eval.tables.grids import psnr_text

DPI = 100
PANEL = 300
"""Least side of a panel in pixels; pictures are enlarged by an integer factor to reach it."""
GAP, CAPTION, HEADING, MARGIN, SIDE = 14, 26, 64, 20, 44
"""Pixels: between columns, for a row's captions, for title and heads, at the edges, for the split's name."""

ERROR_LIMIT = 32
"""Levels of 255 at which the error's colours saturate; fixed, so that sheets can be compared."""

ERROR_TICKS = (0, 1, 4, 9, 16, 25, 32)


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One picture of a sheet with its caption; None for a split that was not predicted."""

    image: UInt8[np.ndarray, "h w 3"] | Float[np.ndarray, "h w"] | None
    caption: str = ""
    is_best: bool = False


@dataclass(frozen=True, kw_only=True)
class Row:
    """One view of a sheet."""

    split: Split
    panels: tuple[Panel, ...]


def contact_sheet(scene: SceneScores, scores: RunScores) -> bytes:
    """The PNG of one run: first, middle and last view of each split as truth, prediction and error."""
    rows = []
    for split, view in shown_views(scene):
        truth = scene.dataset.view(split, view).image
        panels = [Panel(image=truth, caption=f"view {view_name(view)}"), Panel(image=None), Panel(image=None)]
        if (values := scores.splits[split]) is not None:
            pred = read_prediction(scores.run, split, view)
            error = np.abs(pred.astype(np.float64) - truth).mean(axis=-1)
            panels[1] = Panel(image=pred, caption=psnr_text(values.images["psnr_db"][view]))
            panels[2] = Panel(image=error, caption=f"mean {error.mean():.1f}, largest {error.max():.0f}")
        rows.append(Row(split=split, panels=tuple(panels)))
    heads = ("truth", "prediction", "error, levels of 255")
    about = [text for text in (scores.run.method, scores.run.geometry) if text and text != scores.run.name]
    title = f"{scene.title}: {scores.run.name}" + (f" ({', '.join(about)})" if about else "")
    return draw_sheet(title, heads, rows, size=scene.dataset.config.resolution)


def comparison_sheet(scene: SceneScores, what: str) -> bytes:
    """The PNG of the same views as truth and every run's prediction; each row's best PSNR is bold.

    Args:
        scene: with the runs to show; from those that only differ in their seed, the first is shown.
        what: name of the selection, for the title.
    """
    runs = [group.runs[0] for group in group_seeds(scene.runs)]
    rows = []
    for split, view in shown_views(scene):
        values = [None if s is None else s.images["psnr_db"][view] for s in (run.splits[split] for run in runs)]
        best = max((value for value in values if value is not None), default=None)
        panels = [Panel(image=scene.dataset.view(split, view).image, caption=f"view {view_name(view)}")]
        for scores, value in zip(runs, values, strict=True):
            if value is None:
                panels.append(Panel(image=None))
            else:
                pred = read_prediction(scores.run, split, view)
                panels.append(Panel(image=pred, caption=psnr_text(value), is_best=value == best))
        rows.append(Row(split=split, panels=tuple(panels)))
    heads = ("truth", *(scores.run.name for scores in runs))
    return draw_sheet(f"{scene.title}: {what}", heads, rows, size=scene.dataset.config.resolution)


def shown_views(scene: SceneScores) -> list[tuple[Split, int]]:
    """First, middle and last view of each test split, without repeats."""
    shown: list[tuple[Split, int]] = []
    for split in TEST_SPLITS:
        last = scene.dataset.config.split(split).views - 1
        for view in sorted({0, (last + 1) // 2, last}):
            shown.append((split, view))
    return shown


def figure_png(figure: Figure) -> bytes:
    """The figure as a PNG that depends only on the figure."""
    buffer = io.BytesIO()
    names_as_they_are(figure)
    # matplotlib would write its own version into the file.
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()


def draw_sheet(title: str, heads: Sequence[str], rows: Sequence[Row], *, size: Resolution) -> bytes:
    """Lays panels out in whole pixels, so that nearest-neighbour enlargement is exact."""
    scale = math.ceil(PANEL / size.shorter)
    high, wide = scale * size.height, scale * size.width
    has_error = any(panel.image is not None and panel.image.ndim == 2 for row in rows for panel in row.panels)
    bar = 70 if has_error else 0
    width = SIDE + len(heads) * (wide + GAP) - GAP + bar + MARGIN
    height = HEADING + len(rows) * (high + CAPTION) + MARGIN
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")

    def text(x: int, y: int, words: str, **style: Any) -> None:
        figure.text(x / width, 1 - y / height, words, **style)

    text(SIDE, 24, _fitting(title, width - SIDE), fontsize=14, weight="bold", va="center")
    for column, head in enumerate(heads):
        x = SIDE + column * (wide + GAP) + wide // 2
        text(x, HEADING - 10, _fitting(head, wide), fontsize=11, ha="center", va="center")
    for place, row in enumerate(rows):
        top = HEADING + place * (high + CAPTION)
        text(SIDE // 2, top + high // 2, row.split, fontsize=11, ha="center", va="center", rotation=90)
        for column, panel in enumerate(row.panels):
            left = SIDE + column * (wide + GAP)
            axes = figure.add_axes((left / width, 1 - (top + high) / height, wide / width, high / height))
            _fill(axes, panel)
            text(
                left + wide // 2,
                top + high + 11,
                panel.caption,
                fontsize=10,
                ha="center",
                va="center",
                weight="bold" if panel.is_best else "normal",
            )
    if has_error:
        left, extent = width - MARGIN - bar + 20, min(2 * high, height - HEADING - MARGIN - CAPTION)
        axes = figure.add_axes((left / width, 1 - (HEADING + extent) / height, 14 / width, extent / height))
        _color_bar(figure, axes)
    return figure_png(figure)


def _fill(axes: Axes, panel: Panel) -> None:
    axes.set_axis_off()
    axes.set(xticks=[], yticks=[])  # matplotlib makes them all the same, which is most of the time of a sheet.
    if panel.image is None:
        axes.text(0.5, 0.5, "no predictions", ha="center", va="center", color="0.5")
    elif panel.image.ndim == 3:
        axes.imshow(panel.image, interpolation="nearest", aspect="auto")
    else:
        norm = PowerNorm(0.5, vmin=0, vmax=ERROR_LIMIT, clip=True)
        axes.imshow(panel.image, interpolation="nearest", aspect="auto", norm=norm, cmap="inferno")


def _color_bar(figure: Figure, axes: Axes) -> None:
    """The scale of the error maps: a square root, so that small errors are visible beside large ones."""
    colors = ScalarMappable(PowerNorm(0.5, vmin=0, vmax=ERROR_LIMIT), "inferno")
    bar = figure.colorbar(colors, cax=axes, ticks=list(ERROR_TICKS))
    bar.ax.set_yticklabels([*map(str, ERROR_TICKS[:-1]), f"≥ {ERROR_LIMIT}"])
    bar.ax.tick_params(labelsize=10)


def _fitting(words: str, width: int) -> str:
    """The words, shortened in the middle if they do not fit at about 8 pixels per letter."""
    room = max(8, width // 8)
    return words if len(words) <= room else f"{words[: room - room // 2 - 1]}…{words[-(room // 2) :]}"


SPLIT_COLORS: dict[Split, str] = {"train": "#2f6fdb", "interpolating": "#1a9e3c", "extrapolating": "#d62728"}
"""Blue, green and red, as in the paper's Figure 3."""
FRUSTUM_SHARE = 0.045
"""Length of a test camera's frustum, relative to the extent of all cameras."""
MAX_FACES = 20_000
"""Most triangles to draw; from more, the largest and an even selection of the others."""


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
