"""A plan of the cameras: all splits from above, as frustums around the boxes of the glass objects."""

import math

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Camera, Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import true_meshes
from datagen.data.meshes import is_there
from datagen.data.variants import evenly
from datagen.pages.charts import COLORS
from datagen.pages.html import Markup, Part, tag

MOST_CAMERAS = 120
"""Cameras drawn per split; if there are more, an even selection."""
FRUSTUM_SHARE = 0.04
"""Depth of a drawn frustum, relative to the extent of all cameras."""
SIDE, MARGIN = 1000, 60
"""Side of the drawing and the space around its content, in units of the drawing."""
MARK = 5
"""Units from the middle of a mark to its edge."""
MARKS = ("", "disc", "square")
"""Marks on camera centres: for the first split, the second, and all others."""

Places = Float[np.ndarray, "point 2"]


def path_of(places: Places) -> str:
    """A line through points of a drawing, as SVG path data."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in places)


def draw_cameras(dataset: Dataset) -> Markup:
    """The cameras of all splits and the glass from above, +y up, with a legend of the splits."""
    cameras: dict[Split, Cameras] = {split: dataset.cameras(split) for split in dataset.splits}
    centres = np.concatenate([item.world_from_camera[:, :3, 3] for item in cameras.values()])
    size = FRUSTUM_SHARE * max(float(np.ptp(centres, axis=0).max()), 1e-6)
    frustums: dict[Split, dict[int, np.ndarray]] = {
        split: {view: frustum(item[view], size) for view in evenly(min(MOST_CAMERAS, len(item)), len(item))}
        for split, item in cameras.items()
    }
    boxes = _glass_boxes(dataset)
    seen = np.concatenate([*(points for drawn in frustums.values() for points in drawn.values()), *boxes.values()])
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    scale = (SIDE - 2 * MARGIN) / max(float((high - low).max()), 1e-9)

    def place(p_world: Float[np.ndarray, "point 3"]) -> Places:
        return (p_world[:, :2] - (low + high) / 2) * [scale, -scale] + SIDE / 2

    parts: list[Part] = [
        tag("g", tag("title", name), tag("path", d=path_of(place(corners)) + "Z"), class_="camera")
        for name, corners in boxes.items()
    ]
    for number, (split, drawn) in enumerate(frustums.items()):
        for view, points in drawn.items():
            title, line = tag("title", f"{split} view {view}"), tag("path", d=path_of(place(points)))
            column, row = place(points[:1])[0]
            mark = _mark(number, round(column, 1), round(row, 1))
            parts.append(tag("g", title, line, mark, class_=f"stroke s{number % len(COLORS)}"))
    name = "Cameras from above"
    frame = f"0 0 {SIDE} {SIDE}"
    plan = tag("svg", *parts, class_="drawing", viewBox=frame, role="img", aria_label=name)
    legend = [
        _legend_line(number, split, len(frustums[split]), len(item))
        for number, (split, item) in enumerate(cameras.items())
    ]
    keys = tag("ul", *legend, class_="legend keys", aria_label="Cameras by split")
    return tag("div", tag("figure", plan, tag("figcaption", f"{name}, and the glass")), keys, class_="drawings")


def frustum(camera: Camera, depth: float) -> Float[np.ndarray, "point 3"]:
    """The edges of a camera's view pyramid as one stroke, `depth` metres deep."""
    across = math.tan(camera.fov_x / 2) * depth
    along = across * camera.height / camera.width
    corners = [np.array([x * across, y * along, -depth]) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    a, b, c, d = (camera.world_from_camera[:3, :3] @ corner + camera.world_from_camera[:3, 3] for corner in corners)
    apex = camera.world_from_camera[:3, 3]
    return np.array([apex, a, b, apex, c, d, apex, b, c, d, a])


def _glass_boxes(dataset: Dataset) -> dict[str, Float[np.ndarray, "4 3"]]:
    """Corners of the bounding box of each glass object, from above."""
    boxes = {}
    for item, mesh in zip(dataset.objects, true_meshes(dataset), strict=True):
        if item.is_glass and is_there(mesh):
            (x, y, z), (end_x, end_y, _) = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
            boxes[item.name] = np.array([(x, y, z), (end_x, y, z), (end_x, end_y, z), (x, end_y, z)], np.float64)
    return boxes


def _legend_line(number: int, split: str, drawn: int, count: int) -> Markup:
    frustum = tag("path", d="M6 10L26 2V18ZM6 10L32 6V14Z")
    kind = f"key stroke s{number % len(COLORS)}"
    key = tag("svg", frustum, _mark(number, 6, 10), class_=kind, viewBox="0 0 36 20", aria_hidden="true")
    said = f"{count:,} cameras" if drawn == count else f"{drawn:,} of {count:,} cameras"
    return tag("li", key, f"{split}: {said}")


def _mark(number: int, x: float, y: float) -> Markup | None:
    """The mark of a split on a camera's centre."""
    kind = MARKS[min(number, len(MARKS) - 1)]
    if kind == "disc":
        return tag("circle", cx=x, cy=y, r=MARK)
    return tag("rect", x=x - MARK, y=y - MARK, width=2 * MARK, height=2 * MARK) if kind else None
