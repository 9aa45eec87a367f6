"""Panes: level glass objects so thin that they hardly displace the view through them.

Depth maps look through them. Thick or round glass shows its surroundings elsewhere, so it is left out there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, UInt8

from datagen.data.cameras import Cameras
from datagen.data.meshes import Mesh
from hyaline_photos.capture.outlines import GAP, Outline, ids_at
from hyaline_photos.capture.rectangles import Flat, Rectangle, smallest_rectangle

MAX_THICKNESS = 0.1
"""Thickness of a pane over its narrower side."""
HEIGHTS, SIDE, VIEWS = 25, 48, 48
"""Heights that are tried, points a side of the grid in each, and most of the views that are asked."""
STEEP = 0.2
"""Sine of the elevation above which rays tell the place of a pane."""
LEAST_PIXELS = 30
BAND = 3
"""Pixels on either side of a mask's edge that place a pane's faces."""
STEPS = (0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
"""By which its faces are moved, over its narrower side."""


@dataclass(frozen=True, kw_only=True)
class Pane:
    """A level pane."""

    name: str
    footprint: Rectangle
    top: float
    thickness: float

    @property
    def bottom(self) -> float:
        """Height of its lower face."""
        return self.top - self.thickness

    def outline(self) -> Outline:
        """An upright ellipsoid of the same size."""
        reach = np.abs(self.footprint.axes.T) @ self.footprint.half
        return Outline(
            name=self.name,
            center=(*self.footprint.center, self.top - self.thickness / 2),
            radii=(*reach.tolist(), self.thickness / 2),
        )

    def without(self, mesh: Mesh) -> Mesh:
        """A surface with its vertices inside the pane, where nothing can be, moved out through the nearer face."""
        vertices = mesh.vertices.copy()
        inside = self.footprint.holds(vertices[:, :2]) & (vertices[:, 2] > self.bottom) & (vertices[:, 2] < self.top)
        below = vertices[:, 2] < self.top - self.thickness / 2
        vertices[inside & below, 2] = self.bottom - GAP
        vertices[inside & ~below, 2] = self.top + GAP
        return replace(mesh, vertices=vertices)


def find_panes(
    outlines: Sequence[Outline], ids: Sequence[UInt8[np.ndarray, "h w"]], cameras: Cameras
) -> tuple[Pane, ...]:
    """The objects that are panes.

    Args:
        outlines: of all objects.
        ids: 1 + the place among the outlines of the object that each pixel sees, 0 elsewhere; one picture a camera.
    """
    sizes = np.sum([np.bincount(picture.reshape(-1), minlength=len(outlines) + 1) for picture in ids], axis=0)
    views = range(0, len(cameras), -(-len(cameras) // VIEWS))
    found = (_pane(outline, place + 1, sizes, ids, cameras, views) for place, outline in enumerate(outlines))
    return tuple(pane for pane in found if pane is not None)


def _pane(
    outline: Outline,
    index: int,
    sizes: np.ndarray,
    ids: Sequence[UInt8[np.ndarray, "h w"]],
    cameras: Cameras,
    views: range,
) -> Pane | None:
    rays = [(cameras.world_from_camera[view, :3, 3], cameras[view].rays()[1][ids[view] == index]) for view in views]
    # Masks of smaller objects are in front (`capture._object_ids`); what a larger one shows is not hidden.
    denies = np.array([True, *(sizes[1:] > sizes[index])])
    middle, half = outline.center[2], 1.3 * outline.radii[2]
    best, height, footprint = 0.0, middle, None
    for _ in range(2):
        step = 2 * half / (HEIGHTS - 1)
        for trial in middle + np.linspace(-half, half, HEIGHTS):
            grid = _grid(rays, trial)
            if grid is None:
                continue
            share = _share(np.column_stack([grid, np.full(len(grid), trial)]), index, denies, ids, cameras, views)
            # Seen from anywhere, a flat object covers the same part of its plane.
            score = (share > 0.75).sum() / max(1, (share > 0.25).sum())
            if score > best and (share > 0.5).sum() > SIDE:
                best, height, footprint = float(score), float(trial), smallest_rectangle(grid[share > 0.5], 0.5)
        middle, half = height, step
    if footprint is None:
        return None
    edges = [_edge(cameras, view, ids[view], index, denies) for view in views]
    origins, directions, sees = (np.concatenate(parts) for parts in zip(*edges, strict=True))
    pane = _refined(Pane(name=outline.name, footprint=footprint, top=height, thickness=0.0), origins, directions, sees)
    return pane if pane.thickness < MAX_THICKNESS * 2 * min(pane.footprint.half) else None


def _grid(rays: Sequence[tuple[np.ndarray, np.ndarray]], height: float) -> Flat | None:
    """Points of a level plane around where most rays meet it."""
    places = []
    for origin, directions in rays:
        steep = directions[directions[:, 2] < (-STEEP if origin[2] > height else -np.inf)]
        places.append(origin[:2] + ((height - origin[2]) / steep[:, 2:]) * steep[:, :2])
    flat = np.concatenate([np.zeros((0, 2)), *places])
    if len(flat) < LEAST_PIXELS:
        return None
    low, high = np.percentile(flat, (3, 97), axis=0)
    margin = 0.1 * (high - low)
    axes = [np.linspace(a, b, SIDE) for a, b in zip(low - margin, high + margin, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def _share(
    points: Float[np.ndarray, "point 3"],
    index: int,
    denies: Bool[np.ndarray, " id"],
    ids: Sequence[UInt8[np.ndarray, "h w"]],
    cameras: Cameras,
    views: range,
) -> Float[np.ndarray, " point"]:
    """The share of the views that see an object at points, of those that see it or nothing in front of it."""
    yes, views_of = np.zeros(len(points)), np.zeros(len(points))
    for view in views:
        shown, found = ids_at(points, ids[view], cameras[view])
        yes += shown & (found == index)
        views_of += shown & ((found == index) | denies[found])
    return yes / np.maximum(views_of, 1)


def _edge(
    cameras: Cameras, view: int, picture: UInt8[np.ndarray, "h w"], index: int, denies: Bool[np.ndarray, " id"]
) -> tuple[Float[np.ndarray, "ray 3"], Float[np.ndarray, "ray 3"], Bool[np.ndarray, " ray"]]:
    """Rays of pixels near the edge of an object's mask where nothing hides it, and whether they see it."""
    from scipy.ndimage import binary_dilation

    mask, around = picture == index, np.ones((2 * BAND + 1, 2 * BAND + 1), bool)
    band = np.asarray(binary_dilation(mask, around), bool) & np.asarray(binary_dilation(~mask, around), bool)
    near = band & (mask | denies[picture])
    directions = cameras[view].rays()[1][near].astype(np.float64)
    return np.broadcast_to(cameras.world_from_camera[view, :3, 3], directions.shape), directions, mask[near]


def _refined(
    pane: Pane,
    origins: Float[np.ndarray, "ray 3"],
    directions: Float[np.ndarray, "ray 3"],
    sees: Bool[np.ndarray, " ray"],
) -> Pane:
    """The pane whose silhouettes differ least from masks, by steps of one number at a time."""
    axes, side = pane.footprint.axes, 2 * min(pane.footprint.half)
    start = np.column_stack([(origins[:, :2] - pane.footprint.center) @ axes.T, origins[:, 2] - pane.top])
    ahead = np.column_stack([directions[:, :2] @ axes.T, directions[:, 2]])
    ahead = np.where(np.abs(ahead) < 1e-9, 1e-9, ahead)
    box = np.array([-pane.footprint.half[0], -pane.footprint.half[1], 0, *pane.footprint.half, 0], np.float64)

    def wrong(box: Float[np.ndarray, "6"]) -> float:
        ends = np.stack([(box[:3] - start) / ahead, (box[3:] - start) / ahead])
        near, far = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        return float(np.mean((near < far) != sees)) if (box[3:] >= box[:3]).all() else 1.0

    least = wrong(box)
    for step in side * np.array(STEPS):
        for face, sign in product(range(6), (-1, 1)):
            while (trial := wrong(moved := box + sign * step * (np.arange(6) == face))) < least:
                box, least = moved, trial
    middle = (box[:2] + box[3:5]) / 2 @ axes + pane.footprint.center
    half = (box[3:5] - box[:2]) / 2
    footprint = replace(pane.footprint, center=tuple(middle.tolist()), half=tuple(half.tolist()))
    return replace(pane, footprint=footprint, top=float(pane.top + box[5]), thickness=float(box[5] - box[2]))
