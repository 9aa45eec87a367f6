"""Cameras around the scene as inline SVG: in space, from above and from the side."""

import math

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Camera, Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import true_meshes
from datagen.data.meshes import Mesh
from datagen.look.turnable import Stroke, draw_turnable
from datagen.pages.html import Markup, Part, tag

SIDE = 420
"""Units of the drawing's longer side."""
FRAME_SHARE = 0.04
"""Depth of a camera's pyramid in space, as a share of how far the cameras are apart."""
MOST_POINTS = 1500
"""Vertices drawn of all meshes together, about."""
SPLIT_STYLES: dict[str, str] = {"train": "s0", "interpolating": "s2"}
"""Other splits test how a renderer extrapolates, and are red."""


def draw_cameras(dataset: Dataset) -> Markup:
    """All cameras around a selection of the scene's vertices: in space, and from two sides."""
    cameras: dict[Split, Cameras] = {split: dataset.cameras(split) for split in dataset.splits}
    vertices = surface_points(true_meshes(dataset))
    views = [("from above", (0, 1)), ("from the side", (0, 2))]
    drawings = [_draw(cameras, vertices, axes, name) for name, axes in views]
    names = [tag("li", f"{split} ({len(item)})", class_=_style(split)) for split, item in cameras.items()]
    in_space = tag("figure", tag("figcaption", "Cameras in space"), _draw_in_space(cameras, vertices))
    return tag("figure", tag("div", in_space, *drawings, class_="views"), tag("ul", *names, class_="legend"))


def surface_points(meshes: tuple[Mesh, ...]) -> Float[np.ndarray, "vertex 3"]:
    """A selection of vertices, of each mesh about as many: a small object is to be seen as well as a large one."""
    share = -(-MOST_POINTS // max(1, len(meshes)))
    points = [mesh.vertices[:: max(1, len(mesh.vertices) // share)].astype(np.float64) for mesh in meshes]
    return np.concatenate([np.zeros((0, 3)), *points])


def _draw_in_space(cameras: dict[Split, Cameras], vertices: Float[np.ndarray, "vertex 3"]) -> Markup:
    places = np.concatenate([item.world_from_camera[:, :3, 3] for item in cameras.values()])
    size = FRAME_SHARE * float(np.linalg.norm(places.max(axis=0) - places.min(axis=0)))
    strokes = [Stroke(points=vertices, are_dots=True)] if len(vertices) else []
    for split, item in cameras.items():
        for view in range(len(item)):
            strokes.append(
                Stroke(points=_frame(item[view], size), says=f"{split} view {view}, in space", style=_style(split))
            )
    return draw_turnable(strokes, "Cameras in space", places)


def _frame(camera: Camera, size: float) -> Float[np.ndarray, "point 3"]:
    """The edges of the pyramid that a camera sees, in one stroke."""
    across = math.tan(camera.fov_x / 2) * size
    along = across * camera.height / camera.width
    corners = [np.array([x * across, y * along, -size]) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    a, b, c, d = (camera.world_from_camera[:3, :3] @ corner + camera.world_from_camera[:3, 3] for corner in corners)
    apex = camera.world_from_camera[:3, 3]
    return np.array([apex, a, b, apex, c, d, apex, b, c, d, a])


def _draw(
    cameras: dict[Split, Cameras], vertices: Float[np.ndarray, "vertex 3"], axes: tuple[int, int], name: str
) -> Markup:
    places = np.concatenate([item.world_from_camera[:, :3, 3] for item in cameras.values()])
    points = np.concatenate([places, vertices])[:, axes]
    low, high = points.min(axis=0), points.max(axis=0)
    scale = SIDE / max(float((high - low).max()), 1e-9)
    width, height = (high - low) * scale + 20

    def place(p_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 2"]:
        x, y = ((p_world[:, axes] - low) * scale + 10).T
        return np.stack([x, height - y], axis=1).round(1)

    dots = [tag("circle", cx=x, cy=y, r=1) for x, y in place(vertices)]
    parts: list[Part] = [tag("title", f"Cameras {name}"), tag("g", *dots, class_="grid dots")]
    for split, item in cameras.items():
        centers = item.world_from_camera[:, :3, 3]
        ends = centers - item.world_from_camera[:, :3, 2] * (18 / scale)  # A camera looks along its -z.
        marks: list[Part] = []
        for view, ((x, y), (to_x, to_y)) in enumerate(zip(place(centers), place(ends), strict=True)):
            said = tag("title", f"{split} view {view}")
            marks.append(tag("g", said, tag("circle", cx=x, cy=y, r=2.5), tag("path", d=f"M{x} {y}L{to_x} {to_y}")))
        parts.append(tag("g", *marks, class_=f"line {_style(split)}"))
    drawing = tag(
        "svg", *parts, class_="chart", viewBox=f"0 0 {width:.0f} {height:.0f}", role="img", aria_label=f"Cameras {name}"
    )
    return tag("figure", tag("figcaption", f"Cameras {name}"), drawing)


def _style(split: str) -> str:
    return SPLIT_STYLES.get(split, "s3")
