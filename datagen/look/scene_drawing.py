"""All cameras around the scene, drawn from in front, from above and from the side."""

import math

import numpy as np
from jaxtyping import Bool

from datagen.data.cameras import Camera, Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import true_meshes
from datagen.data.meshes import Mesh, is_there
from datagen.data.variants import evenly
from datagen.look.sketch import HEIGHT, WIDTH, Points, Sketch, draw_sketch, stand
from datagen.pages.charts import COLORS
from datagen.pages.html import Markup, tag

MOST_CAMERAS = 120
"""Drawn of each split; an even selection of more."""
FRUSTUM_SHARE = 0.045
"""Depth of a drawn camera's frustum, as a share of how far the cameras are apart; smaller for more than `MANY`."""
MANY = 40
MARKS = ("", "disc", "square")
"""On the centres of the cameras of the first split, of the second, and of all others."""
MARK = 5
"""Pixels from the middle of such a mark to its edge."""
VIEWS = (("from in front", 35.0, 28.0, 1), ("from above", 0.0, 90.0, 2), ("from the side", 90.0, 0.0, 2))
"""A name, degrees to the right of where the cameras are and above them, and by how much the drawing is smaller."""


def draw_cameras(dataset: Dataset) -> Markup:
    """The cameras of every split as frustums around the scene, and a legend of the splits."""
    cameras: dict[Split, Cameras] = {split: dataset.cameras(split) for split in dataset.splits}
    meshes, is_glass = true_meshes(dataset), np.array([item.is_glass for item in dataset.objects], bool)
    around = np.concatenate([item.world_from_camera[:, :3, 3] for item in cameras.values()])
    crowding = math.sqrt(max(1.0, sum(min(MOST_CAMERAS, len(item)) for item in cameras.values()) / MANY))
    apart = float(np.linalg.norm(around.max(axis=0) - around.min(axis=0)))
    size = FRUSTUM_SHARE / crowding * max(apart, 1e-6)
    frustums: dict[Split, dict[int, Points]] = {
        split: {view: frustum(item[view], size) for view in evenly(min(MOST_CAMERAS, len(item)), len(item))}
        for split, item in cameras.items()
    }
    seen = np.concatenate(
        [around, *(points for drawn in frustums.values() for points in drawn.values()), _looked_at(meshes, is_glass)]
    )
    azimuth_deg = open_azimuth_deg(dataset)
    drawings = []
    for name, turn_deg, elevation_deg, smaller in VIEWS:
        place = stand(seen, azimuth_deg + turn_deg, elevation_deg, width=WIDTH // smaller, height=HEIGHT // smaller)
        sketch = draw_sketch(meshes, is_glass, place)
        drawings.append(tag("figure", _draw(sketch, frustums, name), tag("figcaption", f"Cameras {name}")))
    legend = [
        _legend_line(place, split, len(frustums[split]), len(item))
        for place, (split, item) in enumerate(cameras.items())
    ]
    large, *small = drawings
    keys = tag("ul", *legend, class_="legend keys", aria_label="Cameras by split")
    return tag("div", large, tag("div", *small, class_="small"), keys, class_="drawings")


def open_azimuth_deg(dataset: Dataset) -> float:
    """The side of the scene on which its training cameras are: no wall hides what they see."""
    towards = np.zeros(3)
    for split in dataset.splits:
        towards += dataset.cameras(split).world_from_camera[:, :3, 2].mean(axis=0)  # A camera looks along its -z.
    return math.degrees(math.atan2(towards[1], towards[0]))


def _looked_at(meshes: tuple[Mesh, ...], is_glass: Bool[np.ndarray, " mesh"]) -> Points:
    """The corners of the glass, which the cameras are there for; of all meshes where nothing is glass."""
    there = [(mesh, glass) for mesh, glass in zip(meshes, is_glass, strict=True) if is_there(mesh)]
    chosen = [mesh for mesh, glass in there if glass] or [mesh for mesh, _ in there]
    corners = [np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]).astype(np.float64) for mesh in chosen]
    return np.concatenate([np.zeros((0, 3)), *corners])


def frustum(camera: Camera, depth: float) -> Points:
    """The edges of the pyramid that a camera sees, in one stroke, that many metres deep."""
    across = math.tan(camera.fov_x / 2) * depth
    along = across * camera.height / camera.width
    corners = [np.array([x * across, y * along, -depth]) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    a, b, c, d = (camera.world_from_camera[:3, :3] @ corner + camera.world_from_camera[:3, 3] for corner in corners)
    apex = camera.world_from_camera[:3, 3]
    return np.array([apex, a, b, apex, c, d, apex, b, c, d, a])


def _draw(sketch: Sketch, frustums: dict[Split, dict[int, Points]], name: str) -> Markup:
    parts = []
    for place, (split, drawn) in enumerate(frustums.items()):
        color, mark = _style(place)
        for view, points in drawn.items():
            line = sketch.stroke(points, says=f"{split} view {view}", class_=color)
            column, row, _ = sketch.standpoint.place(points[:1])[0]
            parts.append(tag("g", line, _mark(mark, round(column, 1), round(row, 1)), class_=color))
    return sketch.svg(*parts, name=f"Cameras {name}")


def _legend_line(place: int, split: str, drawn: int, count: int) -> Markup:
    color, mark = _style(place)
    frustum = tag("path", d="M6 10L26 2V18ZM6 10L32 6V14Z")
    key = tag("svg", frustum, _mark(mark, 6, 10), class_=f"key stroke {color}", viewBox="0 0 36 20", aria_hidden="true")
    said = f"{count:,} cameras" if drawn == count else f"{drawn:,} of {count:,} cameras"
    return tag("li", key, f"{split}: {said}")


def _mark(kind: str, x: float, y: float) -> Markup | None:
    if kind == "disc":
        return tag("circle", cx=x, cy=y, r=MARK)
    return tag("rect", x=x - MARK, y=y - MARK, width=2 * MARK, height=2 * MARK) if kind else None


def _style(place: int) -> tuple[str, str]:
    """The colour and the mark of a split."""
    return f"s{place % len(COLORS)}", MARKS[min(place, len(MARKS) - 1)]
