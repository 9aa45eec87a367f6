"""Cameras around the scene as inline SVG: seen from above and from the side."""

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.data.paths import TRUTH
from datagen.pages.html import Markup, Part, tag

SIDE = 420
"""Units of the drawing's longer side."""
MOST_POINTS = 1500
"""Vertices drawn of all meshes together."""
SPLIT_STYLES: dict[str, str] = {"train": "s0", "interpolating": "s2"}
"""Other splits test how a renderer extrapolates, and are red."""


def draw_cameras(dataset: Dataset) -> Markup:
    """Both views of all cameras, and of a selection of the scene's vertices."""
    cameras: dict[Split, Cameras] = {split: dataset.cameras(split) for split in dataset.splits}
    vertices = np.concatenate([mesh.vertices for mesh in read_meshes(dataset, TRUTH)]).astype(np.float64)
    vertices = vertices[:: -(-len(vertices) // MOST_POINTS)]
    views = [("from above", (0, 1)), ("from the side", (0, 2))]
    drawings = [_draw(cameras, vertices, axes, name) for name, axes in views]
    names = [tag("li", f"{split} ({len(item)})", class_=_style(split)) for split, item in cameras.items()]
    return tag("figure", tag("div", *drawings, class_="views"), tag("ul", *names, class_="legend"))


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
