"""Pictures for people: a view's stored data, a dataset's cameras from above, light paths over a view's picture.

A ray from the camera splits where it hits glass: one part is refracted, the other reflected. Each is followed until it
ends on something opaque or leaves for the sky.
"""

import colorsys
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from datagen.data.cameras import Camera
from datagen.data.config import Split
from datagen.data.dataset import Dataset, View
from datagen.data.geometries import list_geometries, read_meshes
from datagen.data.layers import record_path_of_layers
from datagen.data.meshes import is_there
from datagen.data.paths import TRUTH, layers_root
from datagen.data.variants import evenly
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.pages.charts import COLORS
from datagen.quantities import Surfaces, quantities, surfaces_of
from datagen.terminal.plugins import naming_parts
from datagen.trace.light_path import TracedPaths

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Picture = UInt8[np.ndarray, "h w 3"]

NOTHING = (24, 24, 24)
"""The colour of pixels without a surface."""
TONES = ((0.55, 0.95), (0.85, 0.75), (0.35, 0.8))
"""Saturations and values of objects, in turn, so that they differ in more than hue."""
NEAREST, FARTHEST = 255, 40
"""Grey levels of the nearest and the farthest pixel in a depth picture."""
PIXELS = 900
"""Longer side of a drawing."""
DPI = 144
"""At half the width, as on a phone, texts still have their size."""
MOST_CAMERAS = 120
"""Cameras drawn per split; if there are more, an even selection."""
FRUSTUM_SHARE = 0.04
"""Depth of a drawn camera, relative to the extent of all cameras."""
RAYS = 5
"""Rays whose paths are drawn."""
MOST_VIEWS = 8
"""Training views that are searched for the one with the best examples."""
ASKED = 40
"""Candidate rays along the longer side of a picture, at most."""
MOST_SURFACES = 10
"""Paths with more surfaces are not used as examples."""
SKY_REACH = 0.3
"""Length of the line to the sky, relative to the distance from the camera to the glass."""
SKY = "sky"


def stored_pictures(view: View) -> dict[str, Picture]:
    """Pictures of all that is stored of a view, by name: its own, what its layers show, and proxies laid over it.

    Raises if anything cannot be read.
    """
    dataset, split, index = view.dataset, view.split, view.index
    peeled = [
        geometry
        for geometry in list_geometries(dataset)
        if record_path_of_layers(layers_root(dataset.root, geometry), split, index).is_file()
    ]
    pictures = {"picture": view.image}
    if TRUTH not in peeled:
        if (mask := view.imported_mask) is not None:
            pictures["glass"] = np.where(mask[..., None], view.image, view.image // 5)
        if (depth := view.imported_depth) is not None:
            pictures["depth"] = depth_picture(depth, depth > 0)
        return pictures
    layers = view.layers()
    colors = object_colors(len(view.dataset.objects))
    found = quantities(view)
    pictures["glass"] = np.where(found.glass[..., None], view.image, view.image // 5)
    pictures["depth"] = depth_picture(layers.depth[0], layers.object_id[0] > 0)
    normals = (127.5 * (found.normal() + 1)).clip(0, 255).astype(np.uint8)
    is_there = (layers.object_id[0] > 0)[..., None]
    pictures["normals"] = np.where(is_there, normals, np.array(NOTHING, np.uint8))
    for number, ids in enumerate(layers.object_id):
        if ids.any():
            pictures[f"layer {number}"] = colors[ids]
    for geometry in peeled[1:]:
        ids = view.object_ids(geometry)[0]
        pictures[geometry] = (0.55 * view.image + 0.45 * colors[ids]).astype(np.uint8)
    return pictures


def object_colors(count: int) -> UInt8[np.ndarray, "id 3"]:
    """A colour for each object id, with neighbouring ids far apart; `NOTHING` for 0."""
    hues = [colorsys.hsv_to_rgb((0.61803 * place) % 1, *TONES[place % len(TONES)]) for place in range(count)]
    return np.concatenate([[NOTHING], 255 * np.array(hues).reshape(-1, 3)]).astype(np.uint8)


def depth_picture(depth: Float32[np.ndarray, "h w"], is_there: Bool[np.ndarray, "h w"]) -> Picture:
    """Depth as grey: near is bright, black means no surface. The nearest and the farthest pixel span the scale."""
    picture = np.zeros((*depth.shape, 3), np.uint8)
    if not is_there.any():
        return picture
    near, far = float(depth[is_there].min()), float(depth[is_there].max())
    share = (depth[is_there] - near) / max(far - near, 1e-9)
    picture[is_there] = (NEAREST - (NEAREST - FARTHEST) * share).astype(np.uint8)[:, None]
    return picture


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnPath:
    """One branch of a camera's ray."""

    ray: int
    """Number of the ray in the drawing, from 1."""
    pixel: tuple[int, int]
    """Column and row."""
    points: Float[np.ndarray, "point 3"]
    """The camera, the surfaces along the path, and its end, or a point towards the sky; in metres."""
    through: str
    """Names of the objects before its end."""
    end: str
    """Name of the object on which it ends, or `SKY`."""
    is_reflected: bool
    """Whether it is reflected at the first surface; otherwise it is refracted there."""


def draw_cameras(dataset: Dataset) -> Picture:
    """The cameras of all splits as wedges, and the boxes of the glass, from above with +y up."""
    cameras = {split: dataset.cameras(split) for split in dataset.splits}
    places = np.concatenate([item.world_from_camera[:, :2, 3] for item in cameras.values()])
    depth = FRUSTUM_SHARE * max(float(np.ptp(places, axis=0).max()), 1e-6)

    def draw(axes: "Axes") -> None:
        for item, mesh in zip(dataset.objects, read_meshes(dataset, TRUTH) if dataset.objects else (), strict=True):
            if item.is_glass and is_there(mesh):
                low, high = mesh.vertices[:, :2].min(axis=0), mesh.vertices[:, :2].max(axis=0)
                axes.fill(*np.array([low, (high[0], low[1]), high, (low[0], high[1])]).T, color="#9fb6c8")
        for place, (split, views) in enumerate(cameras.items()):
            drawn = evenly(min(MOST_CAMERAS, len(views)), len(views))
            for view in drawn:
                axes.plot(*wedge(views[view], depth)[:, :2].T, color=COLORS[place % len(COLORS)], linewidth=1)
            label = f"{split}: {len(drawn)} of {len(views):,} cameras"
            centres = views.world_from_camera[drawn, :2, 3].T
            axes.plot(*centres, ".", color=COLORS[place % len(COLORS)], label=label)
        axes.set_aspect("equal")
        axes.legend(loc="upper left")

    return _drawing(draw, 1.0)


def wedge(camera: Camera, depth: float) -> Float[np.ndarray, "4 3"]:
    """A camera's place and the ends of its middle row, `depth` metres ahead, as a closed line."""
    across = np.tan(camera.fov_x / 2) * depth
    corners = np.array([(0, 0, 0), (-across, 0, -depth), (across, 0, -depth), (0, 0, 0)])
    return corners @ camera.world_from_camera[:3, :3].T + camera.world_from_camera[:3, 3]


def draw_light_paths(view: View, paths: list[DrawnPath]) -> Picture:
    """Paths over a view's picture, projected straight into it: solid to a disc if refracted, dashed if reflected.

    A ring surrounds each ray's pixel. Lines without a mark at their end lead to the sky or out of the picture.
    """
    camera = view.camera

    def draw(axes: "Axes") -> None:
        axes.imshow(view.image, extent=(0, camera.width, camera.height, 0), interpolation="nearest")
        axes.set(xlim=(0, camera.width), ylim=(camera.height, 0))
        for path in sorted(paths, key=lambda path: not path.is_reflected):
            places = projected(camera, path.points[1:])
            color, style = (COLORS[1], "--") if path.is_reflected else (COLORS[0], "-")
            axes.plot(*places.T, color="white", linewidth=4)
            axes.plot(*places.T, style, color=color, marker="o", markersize=4)
            if path.end != SKY and len(places) == len(path.points) - 1:
                axes.plot(*places[-1], "D" if path.is_reflected else "o", color=color, markersize=9)
        for ray, (column, row) in {path.ray: path.pixel for path in paths}.items():
            at = column + 0.5, row + 0.5
            axes.plot(*at, "o", fillstyle="none", color="white", markersize=18, markeredgewidth=4)
            axes.plot(*at, "o", fillstyle="none", color="black", markersize=18, markeredgewidth=2)
            axes.annotate(str(ray), at, (10, 6), textcoords="offset points", weight="bold", backgroundcolor="white")

    return _drawing(draw, camera.height / camera.width)


def _drawing(draw: Callable[["Axes"], None], aspect: float) -> Picture:
    """What `draw` draws on axes that fill a picture of this height over its width."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width = PIXELS / max(1.0, aspect)
    figure = Figure(figsize=(width / DPI, width * aspect / DPI), dpi=DPI)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.axis("off")
    draw(axes)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


def projected(camera: Camera, p_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "place 2"]:
    """Points of a path in the picture, up to where it passes behind the camera."""
    places, depth = camera.project(p_world)
    behind = np.flatnonzero(depth <= 1e-3 * depth[0])
    return places[: behind[0]] if len(behind) else places


def find_light_paths(dataset: Dataset) -> tuple[View, list[DrawnPath]] | None:
    """Paths of up to `RAYS` rays of one training view: the best of a few, by how far its glass shifts what is seen."""
    if not any(item.is_glass for item in dataset.objects):
        return None
    with naming_parts("datagen look"):
        from datagen.trace.surface_tables import Limits

        use_mitsuba()
        surfaces = surfaces_of(dataset)
        tracer, limits = surfaces.tracer, Limits(max_branches=2, max_vertices=24)
    split: Split = "train" if "train" in dataset.splits else dataset.splits[0]
    cameras = dataset.cameras(split)
    best, found = 0.0, None
    for view in evenly(min(MOST_VIEWS, len(cameras)), len(cameras)):
        camera = cameras[view]
        origin, directions = camera.rays()
        step = -(-max(camera.width, camera.height) // ASKED)
        pixels = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step].reshape(2, -1)[::-1].T
        rays = np.ascontiguousarray(directions[pixels[:, 1], pixels[:, 0]])
        traced = tracer.trace(np.tile(origin, (len(rays), 1)), rays, limits)
        score = _scores(camera, pixels, traced, surfaces)
        if score.sum() > best:
            best, found = score.sum(), (dataset.view(split, view), origin, pixels, traced, _choose(pixels, score))
    if found is None:
        return None
    view, origin, pixels, traced, chosen = found

    def path_of(number: int, ray: int, *, is_reflected: bool) -> DrawnPath | None:
        branch = int(is_reflected)
        ids, has_left = traced.object_id[branch, :, ray], bool(traced.has_left[branch, ray])
        names = [dataset.objects[item - 1].name for item in ids[ids > 0]]
        points = [origin, *traced.position[branch, ids > 0, ray]]
        if is_reflected:
            if not names and not has_left:
                return None
            names = [dataset.objects[traced.object_id[0, 0, ray] - 1].name, *names]
            points = [origin, traced.position[0, 0, ray], *points[1:]]
        if has_left:
            reach = SKY_REACH * float(np.linalg.norm(points[1] - origin))
            points.append(points[-1] + reach * traced.end_direction[branch, ray])
            names.append(SKY)
        return DrawnPath(
            ray=number,
            pixel=(int(pixels[ray, 0]), int(pixels[ray, 1])),
            points=np.array(points, np.float64),
            through=", ".join(dict.fromkeys(names[:-1])),
            end=names[-1],
            is_reflected=is_reflected,
        )

    paths = [path_of(number, ray, is_reflected=kind) for number, ray in enumerate(chosen, 1) for kind in (False, True)]
    return view, [path for path in paths if path is not None]


def _scores(
    camera: Camera, pixels: Int[np.ndarray, "ray 2"], traced: TracedPaths, surfaces: Surfaces
) -> Float[np.ndarray, " ray"]:
    """0 for rays that miss the glass, else a little more than the distance in widths from the pixel to the ray's end in
    the picture, if that is seen."""
    ids = traced.object_id[0]
    count = (ids > 0).sum(axis=0)
    last = traced.position[0, np.maximum(count - 1, 0), np.arange(len(pixels))].astype(np.float64)
    seen, depth = camera.project(last)
    is_inside = (depth > 0) & (seen > 0).all(axis=1) & (seen < (camera.width, camera.height)).all(axis=1)
    shift = np.linalg.norm(seen - pixels - 0.5, axis=1) / camera.width
    is_seen = is_inside & ~traced.has_left[0] & (count <= MOST_SURFACES)
    is_fit = surfaces.is_glass[ids[0]] & ((count > 1) | traced.has_left[0])
    return np.where(is_fit, np.where(is_seen, shift, 0) + 1e-3, 0)


def _choose(pixels: Int[np.ndarray, "ray 2"], score: Float[np.ndarray, " ray"]) -> list[int]:
    """The rays of the highest scores that are apart from each other."""
    chosen: list[int] = []
    while len(chosen) < RAYS and score.max() > 0:
        chosen.append(int(score.argmax()))
        score = np.where(np.linalg.norm(pixels - pixels[chosen[-1]], axis=1) < np.ptp(pixels) / 8, 0, score)
    return chosen
