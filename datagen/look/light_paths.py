"""Light paths drawn through the scene: a few rays of training views that meet glass, coloured by what they end on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.meshes import is_there
from datagen.data.variants import evenly
from datagen.look.scene_drawing import surface_points
from datagen.look.turnable import Stroke, draw_turnable
from datagen.look.view_pictures import object_colors
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.pages.html import Markup, tag
from datagen.quantities.surfaces import surfaces_of
from datagen.terminal.distribution import naming_parts
from datagen.trace.limits import Limits

VIEWS, RAYS = 3, 12
"""Views whose rays are followed, and rays of each at most."""
ASKED = 24
"""Rays along the longer side of a picture, at most, among which those that meet glass are sought."""
LIMITS = Limits(max_branches=2, max_vertices=24)
SURROUNDINGS = 1.6
"""How much more than the glass the drawing shows."""
SKY = "sky"
SKY_COLOR = "#8fb7e8"


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnPath:
    """One branch of a ray."""

    points: Float[np.ndarray, "point 3"]
    """Metres, from before the first surface to the end."""
    end: int
    """Id of the object on which it ends; 0: the sky."""
    is_mirrored: bool
    """Reflected at the first surface; else refracted there."""
    says: str


def draw_light_paths(dataset: Dataset) -> Markup:
    """The paths among the scene's vertices, and a legend of what they end on.

    Raises:
        HyalineError: what traces them is not installed, or knows no such material.
    """
    paths = find_light_paths(dataset)
    if not paths:
        return tag("p", "No ray of the training views meets glass.")
    colors = [SKY_COLOR, *("#" + bytes(map(int, color)).hex() for color in object_colors(len(dataset.objects))[1:])]
    names = [SKY, *(item.name for item in dataset.objects)]
    meshes = surfaces_of(dataset).meshes
    strokes = [
        Stroke(points=surface_points(meshes), are_dots=True),
        *(
            Stroke(points=path.points, says=path.says, color=colors[path.end], is_faint=path.is_mirrored)
            for path in paths
        ),
    ]
    ends = np.bincount([path.end for path in paths], minlength=len(names))
    legend = [tag("li", _swatch(colors[end]), f"{names[end]} ({ends[end]})") for end in np.argsort(-ends) if ends[end]]
    caption = tag("figcaption", "Light paths of training rays through glass, coloured by what they end on")
    glass = [mesh for mesh, item in zip(meshes, dataset.objects, strict=True) if item.is_glass and is_there(mesh)]
    around = SURROUNDINGS * (corners := np.concatenate([mesh.vertices for mesh in glass]).astype(np.float64))
    around += (1 - SURROUNDINGS) * (corners.min(axis=0) + corners.max(axis=0)) / 2
    drawing = draw_turnable(strokes, "Light paths", around)
    return tag("figure", caption, drawing, tag("ul", *legend, class_="legend swatches"))


def find_light_paths(dataset: Dataset) -> list[DrawnPath]:
    """Paths of rays of a few training views that meet glass, at most `VIEWS` x `RAYS` rays.

    Raises:
        HyalineError: as `draw_light_paths`.
    """
    if not any(item.is_glass for item in dataset.objects):
        return []
    surfaces = surfaces_of(dataset)
    with naming_parts("datagen look"):
        use_mitsuba(quiet=True)
        tracer = surfaces.tracer
    corners = np.concatenate([mesh.vertices for mesh in surfaces.meshes])
    reach = 0.25 * float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0)))
    split: Split = "train" if "train" in dataset.splits else dataset.splits[0]
    count = dataset.num_views[split]
    found = []
    for view in evenly(min(VIEWS, count), count):
        origin, directions = dataset.view(split, view).camera.rays()
        step = -(-max(directions.shape[:2]) // ASKED)
        rays = np.ascontiguousarray(directions[step // 2 :: step, step // 2 :: step]).reshape(-1, 3)
        traced = tracer.trace(np.tile(origin, (len(rays), 1)), rays, LIMITS)
        meets = np.flatnonzero(surfaces.is_glass[traced.object_id[0, 0]])
        for ray in meets[evenly(min(RAYS, len(meets)), len(meets))] if len(meets) else ():
            first = traced.position[0, 0, ray]
            start = first - rays[ray] * min(reach, float(np.linalg.norm(first - origin)))
            for branch in (0, 1):
                ids = traced.object_id[branch, :, ray]
                vertices = traced.position[branch, ids > 0, ray]
                has_left = bool(traced.has_left[branch, ray])
                if branch == 1 and not len(vertices) and not has_left:
                    continue  # Nothing is mirrored there.
                leaving = vertices[-1] if len(vertices) else first
                tail = [leaving + reach * traced.end_direction[branch, ray]] if has_left else []
                points = np.array([start, first, *vertices, *tail], np.float64)
                end = 0 if has_left else int(ids[ids > 0][-1])
                name = SKY if end == 0 else dataset.objects[end - 1].name
                way = "mirrored" if branch else "refracted"
                says = f"{split} view {view}: {way}, {len(vertices)} surfaces, ends on {name}"
                found.append(DrawnPath(points=points, end=end, is_mirrored=branch == 1, says=says))
    return found


def _swatch(color: str) -> Markup:
    return tag("svg", tag("rect", width=10, height=10, fill=color), viewBox="0 0 10 10", class_="swatch")
