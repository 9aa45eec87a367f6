"""Line drawings of a scene, and of its cameras around it: light shading, ink outlines and creases, transparent glass.

The projection is orthographic. Lines drawn into a sketch (cameras, light paths) are paler behind opaque objects.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt8

from datagen.data.cameras import Camera, Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import true_meshes
from datagen.data.meshes import Mesh, face_corners, is_there
from datagen.data.variants import evenly
from datagen.pages.charts import COLORS
from datagen.pages.html import Markup, Part, tag
from datagen.pages.pictures import lossless_uri

WIDTH, HEIGHT = 1200, 900
"""Pixels of a sketch; pages show it at half this size, so that lines stay fine on any screen."""
MARGIN = 50
"""Pixels around the content of a sketch."""
LIGHT = np.array([-0.4, 0.75, 0.55])
"""Direction towards the light, as (right, up, towards the eye)."""
CREASE = math.cos(math.radians(30))
"""Cosine below which a line is drawn between the normals of neighbouring pixels."""
INK, PALE_INK, GLASS_INK = (44, 52, 60), (178, 186, 194), (23, 96, 150)
GLASS_TINT = np.array([0.80, 0.90, 0.97])
LEAST_GAP = 6
"""An object hides another if it is nearer by this many pixels of depth, so that lines on a surface stay visible."""
MOST_PIXELS = 1 << 24
"""Faces are rasterised in batches of about this many pixels."""

Points = Float[np.ndarray, "point 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Viewpoint:
    """The viewpoint of a sketch, and the part of the scene that it shows."""

    middle: Float[np.ndarray, "3"]
    """World position in the middle of the sketch, in metres."""
    axes: Float[np.ndarray, "3 3"]
    """Unit vectors to the right, up and towards the eye, as rows."""
    scale: float
    """Pixels per metre."""
    near: float
    """Distance of the near plane from the middle towards the eye, in metres; anything nearer is cut away."""
    width: int
    height: int

    def place(self, p_world: Points) -> Points:
        """Column and row in pixels, and depth in pixels away from the eye."""
        right, up, towards = ((p_world - self.middle) @ self.axes.T * self.scale).T
        return np.stack([self.width / 2 + right, self.height / 2 - up, -towards], axis=1)


def fit_viewpoint(around: Points, azimuth_deg: float, elevation_deg: float, *, width: int, height: int) -> Viewpoint:
    """The viewpoint that fits points into the frame, as large as possible."""
    a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
    axes = np.array(
        [
            [-math.sin(a), math.cos(a), 0],
            [-math.cos(a) * math.sin(e), -math.sin(a) * math.sin(e), math.cos(e)],
            [math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)],
        ]
    )
    seen = around @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    room = np.array([width, height]) - 2 * MARGIN
    scale = float((room / np.maximum(high - low, 1e-9)[:2]).min())
    near = 0.5 * float(high[2] - low[2]) + MARGIN / scale
    return Viewpoint(middle=(low + high) / 2 @ axes, axes=axes, scale=scale, near=near, width=width, height=height)


def path_of(places: Float[np.ndarray, "point 2"]) -> str:
    """A line through points of a drawing, as SVG path data."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in places)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sketch:
    """A drawn scene."""

    viewpoint: Viewpoint
    depth: Float32[np.ndarray, "h w"]
    """Depth of the nearest opaque surface; infinite if there is none."""
    picture: UInt8[np.ndarray, "h w 4"]

    def svg(self, *parts: Part, name: str) -> Markup:
        """The sketch with parts drawn over it; `name` labels it for screen readers."""
        height, width = self.depth.shape
        scene = tag("image", href=lossless_uri(self.picture), width=width, height=height)
        frame = f"0 0 {width} {height}"
        return tag("svg", scene, *parts, class_="drawing sketch", viewBox=frame, role="img", aria_label=name)

    def stroke(self, p_world: Points, *, label: str, class_: str) -> Markup:
        """A line through world positions, paler behind opaque objects.

        Args:
            label: its tooltip.
        """
        placed = self.viewpoint.place(p_world)
        seen, hidden = [], []
        for start, end in itertools.pairwise(placed):
            line = np.linspace(start, end, int(np.linalg.norm((end - start)[:2]) / 4) + 2)
            is_hidden = self.is_hidden(line)
            breaks = [0, *(np.flatnonzero(is_hidden[1:] != is_hidden[:-1]) + 1), len(line) - 1]
            for first, last in itertools.pairwise(breaks):
                if last > first:
                    (hidden if is_hidden[first] else seen).append(path_of(line[[first, last], :2]))
        drawn = "".join(seen)
        paths = [("hidden", "".join(hidden)), ("halo", drawn), (None, drawn)]
        parts = [tag("path", d=path, class_=kind) for kind, path in paths if path]
        return tag("g", tag("title", label), *parts, class_=f"stroke {class_}")

    def is_hidden(self, placed: Points) -> Bool[np.ndarray, " point"]:
        """Whether points are behind something opaque."""
        height, width = self.depth.shape
        column, row = np.floor(placed[:, :2]).astype(int).T
        is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        nearest = self.depth[row.clip(0, height - 1), column.clip(0, width - 1)]
        return is_inside & (placed[:, 2] > nearest + LEAST_GAP)


def draw_sketch(meshes: tuple[Mesh, ...], is_glass: Bool[np.ndarray, " mesh"], viewpoint: Viewpoint) -> Sketch:
    """The sketch of meshes; glass is transparent."""
    opaque, clear = (
        [mesh for mesh, glass in zip(meshes, is_glass, strict=True) if is_there(mesh) and bool(glass) is which]
        for which in (False, True)
    )
    solid = _Seen(opaque, viewpoint)
    behind = _Seen(opaque, viewpoint, behind=solid.depth)
    glass = _Seen(clear, viewpoint)
    is_seen = glass.is_there & (glass.depth < solid.depth)

    tone = np.where(solid.is_there, 214 + 36 * solid.brightness(), 255)[..., None] * np.ones(3)
    tone = np.where(is_seen[..., None], tone * (GLASS_TINT + 0.1 * (glass.brightness()[..., None] - 0.5)), tone)
    alpha = np.where(solid.is_there | is_seen, 255, 0)
    lines = (
        (behind.lines() & (behind.mesh != solid.mesh), PALE_INK),
        (solid.lines(), INK),
        (glass.lines() & (glass.depth <= solid.depth), GLASS_INK),
    )
    for drawn, ink in lines:
        tone[drawn] = ink
        alpha[drawn] = 255
    picture = np.concatenate([tone, alpha[..., None]], axis=-1).clip(0, 255).astype(np.uint8)
    return Sketch(viewpoint=viewpoint, depth=solid.depth, picture=picture)


class _Seen:
    """The surface of some meshes that is nearest to the eye in each pixel."""

    def __init__(
        self, meshes: list[Mesh], viewpoint: Viewpoint, behind: Float32[np.ndarray, "h w"] | None = None
    ) -> None:
        """
        Args:
            behind: depth; only surfaces farther away count.
        """
        corners = np.concatenate([np.zeros((0, 3, 3)), *map(face_corners, meshes)])
        placed = viewpoint.place(corners.reshape(-1, 3)).reshape(-1, 3, 3)
        least = np.float32(-viewpoint.near * viewpoint.scale)
        shape = viewpoint.height, viewpoint.width
        self._is_thick = viewpoint.width == WIDTH
        floor = np.full(shape, least) if behind is None else behind + np.float32(LEAST_GAP)
        self.depth, face, weights = rasterise(placed, floor)
        self.is_there = face >= 0
        mesh_of_face = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
        self.mesh = np.concatenate([[-1], mesh_of_face])[face + 1]
        normals = np.concatenate([np.zeros((1, 3, 3)), *(mesh.normals[mesh.faces] for mesh in meshes)])
        self._normal = (np.einsum("hwc,hwcx->hwx", weights, normals[face + 1]) @ viewpoint.axes.T).astype(np.float32)
        self._normal /= np.maximum(np.linalg.norm(self._normal, axis=-1, keepdims=True), 1e-9)
        self._normal *= np.where(self._normal[..., 2:] < 0, -1, 1)

    def brightness(self) -> Float32[np.ndarray, "h w"]:
        """Brightness under `LIGHT`, 0 to 1."""
        return (self._normal @ (LIGHT / np.linalg.norm(LIGHT)).astype(np.float32)).clip(0, 1)

    def lines(self) -> Bool[np.ndarray, "h w"]:
        """Outlines of objects, and creases and steps within them: two pixels wide in a large sketch, else one."""
        found = np.zeros(self.depth.shape, bool)
        depth = np.where(self.is_there, self.depth, 1e6)
        for axis in (0, 1):
            mesh, z = np.moveaxis(self.mesh, axis, 0), np.moveaxis(depth, axis, 0)
            normal, out = np.moveaxis(self._normal, axis, 0), np.moveaxis(found, axis, 0)
            other = mesh[1:] != mesh[:-1]
            crease = (normal[1:] * normal[:-1]).sum(axis=-1) < CREASE
            # Where depth is not linear over three pixels, a nearer part covers a farther one.
            bend = np.abs(z[2:] - 2 * z[1:-1] + z[:-2])
            step = np.zeros_like(other)
            step[1:] = bend > LEAST_GAP
            line = other | ((crease | step) & (mesh[1:] >= 0))
            out[1:] |= line
            if self._is_thick:
                out[:-1] |= line
        return found


def rasterise(
    placed: Float[np.ndarray, "face 3 3"], least: Float32[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "h w"], Int64[np.ndarray, "h w"], Float32[np.ndarray, "h w 3"]]:
    """Depth of the nearest face at each pixel's centre, its number (-1: none) and the weights of its corners.

    Args:
        placed: column and row in pixels, and depth, of the corners of each face.
        least: faces count only at pixels where their depth exceeds this.
    """
    (height, width), least = least.shape, least.ravel()
    depth, face = np.full(height * width, np.inf, np.float32), np.full(height * width, -1)
    steps = _steps_of_weights(placed)

    top, bottom = _centres_between(placed[:, :, 1].min(axis=1), placed[:, :, 1].max(axis=1), height)
    of_row, row = _spread(top, bottom)  # A face and a row of pixels that it may cover.
    for part in np.array_split(np.arange(len(row)), len(row) * width // MOST_PIXELS + 1):
        which, y = of_row[part], row[part] + 0.5
        of_pixel, column = _spread(*_centres_between(*_crossings(placed[which], y), width))
        # Along a row, depth changes by the same amount from pixel to pixel.
        corner_z = placed[which, :, 2]
        at_0, at_1 = ((_weights(steps[which], x, y) * corner_z).sum(axis=1) for x in (0.5, 1.5))
        z = at_0[of_pixel] + (at_1 - at_0)[of_pixel] * column
        # Rounding would put some pixels of faces seen nearly edge-on far in front or behind.
        z = np.clip(z, corner_z.min(axis=1)[of_pixel], corner_z.max(axis=1)[of_pixel]).astype(np.float32)
        pixel, which = (row[part] * width)[of_pixel] + column, which[of_pixel]
        counts = z > least[pixel]
        np.minimum.at(depth, pixel[counts], z[counts])
        won = counts & (z == depth[pixel])
        face[pixel[won]] = which[won]

    weights = np.zeros((height * width, 3), np.float32)
    covered = np.flatnonzero(face >= 0)
    weights[covered] = _weights(steps[face[covered]], covered % width + 0.5, covered // width + 0.5)
    shape = height, width
    return depth.reshape(shape), face.reshape(shape), weights.reshape(*shape, 3)


def _steps_of_weights(placed: Float[np.ndarray, "face 3 3"]) -> Float[np.ndarray, "face 3 2"]:
    """Weights of a face's second and third corner: at (0, 0), and their increase per column and per row."""
    a, b, c = placed[:, :, :2].swapaxes(0, 1)
    (bx, by), (cx, cy) = (b - a).T, (c - a).T
    area = bx * cy - by * cx
    area = np.where(area == 0, np.inf, area)  # Seen edge-on: it covers no pixel.
    columns, rows = np.stack([cy, -by], axis=1), np.stack([-cx, bx], axis=1)
    first = -(a[:, :1] * columns + a[:, 1:] * rows)
    return np.stack([first, columns, rows], axis=1) / area[:, None, None]


def _weights(
    steps: Float[np.ndarray, "pixel 3 2"], x: Float[np.ndarray, " pixel"] | float, y: Float[np.ndarray, " pixel"]
) -> Float[np.ndarray, "pixel 3"]:
    others = steps[:, 0] + steps[:, 1] * np.reshape(x, (-1, 1)) + steps[:, 2] * y[:, None]
    return np.concatenate([1 - others.sum(axis=1, keepdims=True), others], axis=1)


def _crossings(
    placed: Float[np.ndarray, "row 3 3"], y: Float[np.ndarray, " row"]
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " row"]]:
    """Where faces begin and end along a line of pixels."""
    left, right = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    for corner in range(3):
        start, end = placed[:, corner], placed[:, (corner + 1) % 3]
        drop = end[:, 1] - start[:, 1]
        share = (y - start[:, 1]) / np.where(drop == 0, np.inf, drop)
        x = start[:, 0] + share * (end[:, 0] - start[:, 0])
        crosses = (share >= 0) & (share <= 1) & (drop != 0)
        left, right = np.where(crosses, np.minimum(left, x), left), np.where(crosses, np.maximum(right, x), right)
    return left, right


def _centres_between(
    low: Float[np.ndarray, " span"], high: Float[np.ndarray, " span"], count: int
) -> tuple[Int64[np.ndarray, " span"], Int64[np.ndarray, " span"]]:
    """The first and the last of `count` pixels whose centres lie between two positions."""
    first = np.ceil(np.clip(low, 0, count + 1) - 0.5).astype(int)
    return first, np.floor(np.clip(high, -1, count) - 0.5).astype(int)


def _spread(
    first: Int64[np.ndarray, " span"], last: Int64[np.ndarray, " span"]
) -> tuple[Int64[np.ndarray, " item"], Int64[np.ndarray, " item"]]:
    """Every number from the first to the last of each span: the span, and the number."""
    counts = np.maximum(last - first + 1, 0)
    span = np.repeat(np.arange(len(first)), counts)
    begins = np.concatenate([[0], np.cumsum(counts)[:-1]]) if len(counts) else counts
    return span, first[span] + np.arange(len(span)) - begins[span]


MOST_CAMERAS = 120
"""Cameras drawn per split; if there are more, an even selection."""
FRUSTUM_SHARE = 0.045
"""Depth of a drawn frustum, relative to the extent of all cameras; smaller for more than `MANY` cameras."""
MANY = 40
MARKS = ("", "disc", "square")
"""Marks on camera centres: for the first split, the second, and all others."""
MARK = 5
"""Pixels from the middle of a mark to its edge."""
VIEWS = (("from in front", 35.0, 28.0, 1), ("from above", 0.0, 90.0, 2), ("from the side", 90.0, 0.0, 2))
"""Name, degrees to the right of the cameras' side, elevation in degrees, and the factor by which it is smaller."""


def draw_cameras(dataset: Dataset) -> Markup:
    """The cameras of all splits as frustums around the scene, and a legend of the splits."""
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
        place = fit_viewpoint(
            seen, azimuth_deg + turn_deg, elevation_deg, width=WIDTH // smaller, height=HEIGHT // smaller
        )
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
    """The azimuth of the side that the cameras look from, in degrees, where no wall blocks the view."""
    towards = np.zeros(3)
    for split in dataset.splits:
        towards += dataset.cameras(split).world_from_camera[:, :3, 2].mean(axis=0)  # A camera looks along its -z.
    return math.degrees(math.atan2(towards[1], towards[0]))


def _looked_at(meshes: tuple[Mesh, ...], is_glass: Bool[np.ndarray, " mesh"]) -> Points:
    """Corners of the bounding boxes of all glass, or of all meshes if there is no glass."""
    there = [(mesh, glass) for mesh, glass in zip(meshes, is_glass, strict=True) if is_there(mesh)]
    chosen = [mesh for mesh, glass in there if glass] or [mesh for mesh, _ in there]
    corners = [np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]).astype(np.float64) for mesh in chosen]
    return np.concatenate([np.zeros((0, 3)), *corners])


def frustum(camera: Camera, depth: float) -> Points:
    """The edges of a camera's view pyramid as one stroke, `depth` metres deep."""
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
            line = sketch.stroke(points, label=f"{split} view {view}", class_=color)
            column, row, _ = sketch.viewpoint.place(points[:1])[0]
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
