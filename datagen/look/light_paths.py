"""Draws the light paths of a few pixels that show glass, over the view's picture.

A ray from the camera splits where it hits glass: one part is refracted, the other reflected. Each is followed until it
ends on something opaque or leaves for the sky.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from datagen.data.cameras import Camera
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.variants import evenly
from datagen.disk.errors import HyalineError
from datagen.look.cameras import path_of
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.pages.html import Markup, Part, anchor, join, prose, tag
from datagen.pages.pictures import Gallery
from datagen.quantities.surfaces import Surfaces, surfaces_of
from datagen.terminal.distribution import naming_parts
from datagen.trace.light_path import TracedPaths
from datagen.trace.surface_tables import Limits

RAYS = 5
"""Rays whose paths are drawn; the glass objects take turns."""
MOST_VIEWS = 8
"""Training views that are searched for the one with the best examples."""
ASKED = 40
"""Candidate rays along the longer side of a picture, at most."""
MOST_SURFACES = 10
"""Paths with more surfaces are not used as examples."""
MOST_SHIFT = 0.4
"""Shifts from a pixel to what it shows count up to this share of the picture's width."""
LIMITS = Limits(max_branches=2, max_vertices=24)
SKY = "sky"
Points = Float[np.ndarray, "point 3"]
SKY_REACH = 0.3
"""Length of the arrow to the sky, relative to the distance from the camera to the glass."""

Candidates = tuple[Int[np.ndarray, " _"], Float[np.ndarray, " _"]]
"""Rays that hit one object first, and the distance in the picture from each ray's pixel to its end."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnPath:
    """One branch of a camera's ray."""

    ray: int
    """Number of the ray in the drawing, from 1."""
    pixel: tuple[int, int]
    """Column and row."""
    points: Points
    """The camera, the surfaces along the path, and its end, or the tip of an arrow to the sky; in metres."""
    through: str
    """Names of the objects before its end."""
    end: int
    """Id of the object on which it ends; 0 for the sky."""
    is_reflected: bool
    """Whether it is reflected at the first surface; otherwise it is refracted there."""

    @property
    def kind(self) -> str:
        return "reflected" if self.is_reflected else "refracted"


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundPaths:
    """The paths of one view."""

    split: Split
    view: int
    camera: Camera
    paths: tuple[DrawnPath, ...]

    def drawn_in_order(self) -> list[DrawnPath]:
        """The paths with refracted ones last, so that they are drawn over reflected ones."""
        return sorted(self.paths, key=lambda path: not path.is_reflected)


def draw_light_paths(dataset: Dataset, gallery: Gallery) -> Markup:
    """The paths over the view's picture, a legend, and a table of the objects on each path."""
    found = find_light_paths(dataset)
    if found is None:
        return tag("p", "No ray of the training views hits glass.")
    name = f"{found.split} view {found.view}"
    picture = anchor(found.split, str(found.view), "picture")
    try:
        has_picture = gallery.add(picture, lambda: dataset.view(found.split, found.view).image)
    except HyalineError as error:
        over = tag("p", prose(str(error)), class_="bad")
    else:
        over = tag(
            "figure",
            _draw_over_picture(found, picture if has_picture else None),
            tag("figcaption", f"In the picture of {name}: the pixel in the ring shows what lies at the large mark"),
        )
    explained = (
        "A ray from the camera splits where it hits glass: one part is refracted, the other is reflected. "
        "Each part is followed until it ends on something opaque or in the sky, which is what the pixel shows."
    )
    beside = tag("div", _legend(), _table(found, dataset))
    return join([tag("p", explained), tag("div", over, beside, class_="drawings")])


def find_light_paths(dataset: Dataset) -> FoundPaths | None:
    """Paths of up to `RAYS` rays of one training view: the best of a few, by how far its glass shifts what is seen."""
    if not any(item.is_glass for item in dataset.objects):
        return None
    surfaces = surfaces_of(dataset)
    with naming_parts("datagen look"):
        use_mitsuba()
        tracer = surfaces.tracer
    split: Split = "train" if "train" in dataset.splits else dataset.splits[0]
    cameras = dataset.cameras(split)
    best: tuple[float, int, list[int], TracedPaths] | None = None
    for view in evenly(min(MOST_VIEWS, len(cameras)), len(cameras)):
        pixels, rays, origin = _rays(cameras[view])
        traced = tracer.trace(np.tile(origin, (len(rays), 1)), rays, LIMITS)
        candidates = _candidates(cameras[view], pixels, traced, surfaces)
        score = sum(float(shifts.max()) for _, shifts in candidates)
        if candidates and (best is None or score > best[0]):
            best = score, view, _choose(pixels, candidates), traced
    if best is None:
        return None
    _, view, chosen, traced = best
    pixels, _, origin = _rays(cameras[view])
    paths = []
    for number, ray in enumerate(chosen, 1):
        paths += _paths_of(number, ray, (int(pixels[ray, 0]), int(pixels[ray, 1])), origin, traced, dataset)
    return FoundPaths(split=split, view=view, camera=cameras[view], paths=tuple(paths))


def _rays(camera: Camera) -> tuple[Int[np.ndarray, "ray 2"], Float[np.ndarray, "ray 3"], Float[np.ndarray, "3"]]:
    """Pixels (column, row) spread over a picture, the rays through them, and their origin."""
    origin, directions = camera.rays()
    step = -(-max(directions.shape[:2]) // ASKED)
    rows, columns = (np.arange(step // 2, count, step) for count in directions.shape[:2])
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    return pixels, np.ascontiguousarray(directions[pixels[:, 1], pixels[:, 0]]), origin


def _candidates(
    camera: Camera, pixels: Int[np.ndarray, "ray 2"], traced: TracedPaths, surfaces: Surfaces
) -> list[Candidates]:
    """For each glass object the rays that hit it first, and the distance in the picture from a ray's pixel to its end.

    The distance is a share of the picture's width; 0 where the end is outside the picture or in the sky.
    """
    ids = traced.object_id[0]
    count = (ids > 0).sum(axis=0)
    last = traced.position[0, np.maximum(count - 1, 0), np.arange(len(pixels))].astype(np.float64)
    seen, depth = camera.project(last)
    is_inside = (depth > 0) & (seen > 0).all(axis=1) & (seen < (camera.width, camera.height)).all(axis=1)
    shift = np.linalg.norm(seen - pixels - 0.5, axis=1) / camera.width
    shift = np.where(is_inside & ~traced.has_left[0] & (count <= MOST_SURFACES), shift, 0)
    found = []
    for item in np.unique(ids[0]):
        rays = np.flatnonzero((ids[0] == item) & (count > 1) | ((ids[0] == item) & traced.has_left[0]))
        if surfaces.is_glass[item] and len(rays):
            found.append((rays, np.minimum(shift[rays], MOST_SHIFT)))
    return sorted(found, key=lambda item: -float(item[1].max()))


def _choose(pixels: Int[np.ndarray, "ray 2"], candidates: list[Candidates]) -> list[int]:
    """Chooses rays, the objects taking turns: each time the most shifted ray away from those chosen before."""
    chosen: list[int] = []
    apart = float(np.ptp(pixels)) / 8
    for _ in range(RAYS):
        for rays, shifts in candidates:
            near = np.linalg.norm(pixels[rays][:, None] - pixels[chosen][None], axis=2).min(axis=1, initial=apart)
            score = np.where(near >= apart, shifts + 1e-3, 0) * (near > 0)
            if len(chosen) < RAYS and score.max() > 0:
                chosen.append(int(rays[score.argmax()]))
    return chosen


def _paths_of(
    number: int,
    ray: int,
    pixel: tuple[int, int],
    origin: Float[np.ndarray, "3"],
    traced: TracedPaths,
    dataset: Dataset,
) -> list[DrawnPath]:
    """The refracted and the reflected branch of one ray."""
    first = traced.position[0, 0, ray]
    reach = SKY_REACH * float(np.linalg.norm(first - origin))
    found = []
    for branch in (0, 1):
        ids = traced.object_id[branch, :, ray]
        vertices = [*([first] if branch else []), *traced.position[branch, ids > 0, ray]]
        has_left = bool(traced.has_left[branch, ray])
        if branch and len(vertices) == 1 and not has_left:
            continue  # No reflection.
        if has_left:
            vertices.append(vertices[-1] + reach * traced.end_direction[branch, ray])
        met = [*([traced.object_id[0, 0, ray]] if branch else []), *ids[ids > 0]]
        end = 0 if has_left else int(met.pop())
        names = dict.fromkeys(dataset.objects[item - 1].name for item in met)
        found.append(
            DrawnPath(
                ray=number,
                pixel=pixel,
                points=np.array([origin, *vertices], np.float64),
                through=", ".join(names),
                end=end,
                is_reflected=branch == 1,
            )
        )
    return found


def _draw_over_picture(found: FoundPaths, picture: str | None) -> Markup:
    """The paths projected straight into the camera's picture, ignoring refraction and occlusion."""
    camera = found.camera
    unit = camera.width / 100
    parts: list[Part] = [] if picture is None else [tag("use", href=f"#{picture}")]
    for path in found.drawn_in_order():
        places, is_inside = _projected(camera, path.points[1:])
        line = join(tag("path", d=path_of(places), class_=kind) for kind in ("halo", None))
        parts.append(_path(path, line, places, unit, is_arrow=not (path.end and is_inside)))
    for ray, (column, row) in {path.ray: path.pixel for path in found.paths}.items():
        x, y = column + 0.5, row + 0.5
        ring = [tag("circle", cx=x, cy=y, r=round(2.4 * unit, 2), class_=kind) for kind in ("ring halo", "ring")]
        beside = 2.8 if x < 0.93 * camera.width else -5
        parts.append(tag("g", *ring, _number(ray, x + beside * unit, max(y - 1.6 * unit, 4 * unit), unit)))
    frame = f"0 0 {camera.width} {camera.height}"
    name = f"Light paths over {found.split} view {found.view}"
    return tag("svg", *parts, class_="drawing over-picture", viewBox=frame, role="img", aria_label=name)


def _projected(camera: Camera, p_world: Points) -> tuple[Float[np.ndarray, "place 2"], bool]:
    """A path in the picture up to where it leaves the picture, and whether all of it is inside."""
    margin = 0.02 * camera.width
    low, high = np.full(2, margin), np.array([camera.width, camera.height]) - margin
    _, depths = camera.project(p_world)
    near = 1e-3 * depths[0]
    places = [camera.project(p_world[:1])[0][0]]
    for start, end, start_depth, end_depth in zip(p_world[:-1], p_world[1:], depths[:-1], depths[1:], strict=True):
        if end_depth < near:
            end = start + (start_depth - near) / (start_depth - end_depth) * (end - start)
        at, to = places[-1], camera.project(end[None])[0][0]
        if (to < low).any() or (to > high).any() or end_depth < near:
            way = np.where(to == at, 1e-12, to - at)
            share = np.maximum((low - at) / way, (high - at) / way).min()
            places.append(at + np.clip(share, 0, 1) * (to - at))
            return np.array(places), False
        places.append(to)
    return np.array(places), True


def _path(
    path: DrawnPath, line: Markup, places: Float[np.ndarray, "point 2"], unit: float, *, is_arrow: bool
) -> Markup:
    """A path's line with a dot at each surface, and a mark and its number at its end."""
    dots = [tag("circle", cx=round(x, 2), cy=round(y, 2), r=round(0.8 * unit, 2), class_="end") for x, y in places[:-1]]
    at, before = places[-1], places[-2] if len(places) > 1 else places[-1] - [0, 1]
    mark = _arrow(before, at, unit) if is_arrow else _end_mark(at, 1.5 * unit, is_reflected=path.is_reflected)
    is_far = np.linalg.norm(at - places[0]) > 8 * unit  # Closer, its number would cover the pixel's.
    number = None if path.is_reflected or not is_far else _number(path.ray, at[0] + 2 * unit, at[1] + 1.2 * unit, unit)
    return tag("g", line, *dots, mark, number, class_=path.kind)


def _number(ray: int, x: float, y: float, unit: float) -> Markup:
    return tag("text", ray, x=round(x, 2), y=round(y, 2), font_size=round(3.2 * unit, 2))


def _end_mark(at: Float[np.ndarray, "2"], size: float, *, is_reflected: bool) -> Markup:
    x, y = at
    if not is_reflected:
        return tag("circle", cx=round(x, 2), cy=round(y, 2), r=round(size, 2), class_="end")
    corners = [(x, y - 1.3 * size), (x + 1.3 * size, y), (x, y + 1.3 * size), (x - 1.3 * size, y)]
    return _polygon(corners)


def _arrow(before: Float[np.ndarray, "2"], at: Float[np.ndarray, "2"], unit: float) -> Markup:
    along = (at - before) / max(float(np.linalg.norm(at - before)), 1e-9) * 2.6 * unit
    across = 0.4 * np.array([-along[1], along[0]])
    return _polygon([at + 0.3 * along, at - along + across, at - along - across])


def _polygon(corners: list) -> Markup:
    return tag("polygon", points=" ".join(f"{x:.2f},{y:.2f}" for x, y in corners), class_="end")


def _legend() -> Markup:
    def key(class_: str, *parts: Part) -> Markup:
        return tag("svg", *parts, class_=f"key {class_}", viewBox="0 0 36 20", aria_hidden="true")

    line, end = tag("path", d="M1 10L26 10"), np.array([29.0, 10.0])
    kinds = [
        tag("li", key(kind, line, _end_mark(end, 4.5, is_reflected=is_reflected)), f"{kind}: {how}")
        for kind, is_reflected, how in (
            ("refracted", False, "solid line, ends at a disc"),
            ("reflected", True, "dashed line, ends at a diamond"),
        )
    ]
    arrow = tag(
        "li",
        key("", line, _arrow(np.array([1.0, 10.0]), np.array([32.0, 10.0]), 3.6)),
        "to the sky, or out of the picture",
    )
    dot = tag("li", key("", line, tag("circle", cx=13, cy=10, r=3)), "hits a surface")
    ring = tag("li", key("", tag("circle", cx=14, cy=10, r=7, class_="ring")), "the ray's pixel")
    return tag("ul", ring, *kinds, arrow, dot, class_="legend keys", aria_label="Light paths")


def _table(found: FoundPaths, dataset: Dataset) -> Markup:
    """The objects on each ray's paths and where they end, in words."""
    names = [SKY, *(item.name for item in dataset.objects)]
    head = tag("tr", *(tag("th", name, scope="col") for name in ("ray", "column, row", "refracted", "reflected")))
    rows = []
    for ray, (column, row) in {path.ray: path.pixel for path in found.paths}.items():
        ways = {path.kind: f"{path.through} → {names[path.end]}" for path in found.paths if path.ray == ray}
        cells = (f"{column}, {row}", ways["refracted"], ways.get("reflected", "nothing"))
        rows.append(tag("tr", tag("th", ray, scope="row"), *(tag("td", cell) for cell in cells)))
    caption = tag("caption", "What each ray hits → where it ends")
    table = tag("table", caption, tag("thead", head), tag("tbody", *rows))
    return tag("div", table, class_="scroll", tabindex=0, role="region", aria_label="Light paths as a table")
