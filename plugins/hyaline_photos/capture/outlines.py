"""Places of glass objects by their masks: upright ellipsoids, which replace the true meshes until `model fit` finds
them, and panes: level objects so thin that they hardly displace the view through them.

Depth maps look through panes. Thick or round glass shows its surroundings elsewhere, so it is left out there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from datagen.data.cameras import Camera, Cameras
from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from hyaline_photos.capture.planes import Rectangle
from hyaline_photos.fit.boxes import fit_box
from hyaline_photos.fit.views import Sightings, rays_near

LEAST_VIEWS = 3
LEAST_PIXELS = 8
"""Smaller masks are left out: they say little, and are often wrong."""
GAP = 0.0005
"""Gap in metres between glass and opaque surfaces that it touches."""
SIDE = 40
"""Points a side of the grid that is carved."""
MAX_OUTSIDE = 0.1
"""Share of the views that may see no glass at a point of an object: masks err, and opaque things hide glass."""
MAX_HIDDEN = 0.35
"""The same, with views that see another object of glass there, which may be in front of it."""
ROOMY = 1.6
"""Side of the first grid over the object's estimated size."""
MAX_THICKNESS = 0.1
"""Thickness of a pane over its narrower side."""


@dataclass(frozen=True, kw_only=True)
class Outline:
    """An upright ellipsoid."""

    name: str
    center: tuple[float, float, float]
    radii: tuple[float, float, float]

    def around(self, points: Float[np.ndarray, "point 3"], *, times: float) -> Bool[np.ndarray, " point"]:
        """True for points in the ellipsoid after scaling it by a factor."""
        return (((points - self.center) / (times * np.array(self.radii))) ** 2).sum(axis=1) < 1

    def moved(self, scale: float, offset: Float[np.ndarray, "3"]) -> "Outline":
        """The same after scaling the world and moving it."""
        center, radii = scale * np.array(self.center) + offset, scale * np.array(self.radii)
        return Outline(name=self.name, center=tuple(center.tolist()), radii=tuple(radii.tolist()))

    def standing_on(self, height: float) -> "Outline":
        """The same above a surface, below which cameras see nothing; as it is if it does not reach into that."""
        low, high = self.center[2] - self.radii[2], self.center[2] + self.radii[2]
        if not low < height < self.center[2]:
            return self
        low = height + GAP
        return Outline(
            name=self.name,
            center=(*self.center[:2], (low + high) / 2),
            radii=(*self.radii[:2], (high - low) / 2),
        )


def find_outlines(
    names: Sequence[str], ids: Sequence[UInt8[np.ndarray, "h w"]], cameras: Cameras, *, where: str
) -> tuple[Outline, ...]:
    """The outline of each object.

    Args:
        ids: 1 + the place among the names of the object that each pixel sees, 0 elsewhere; one picture a camera.
    """
    return tuple(_outline(name, place + 1, ids, cameras, where=f"{where}/{name}") for place, name in enumerate(names))


def _outline(
    name: str, index: int, ids: Sequence[UInt8[np.ndarray, "h w"]], cameras: Cameras, *, where: str
) -> Outline:
    seen = [view for view, picture in enumerate(ids) if (picture == index).sum() >= LEAST_PIXELS]
    if len(seen) < LEAST_VIEWS:
        raise HyalineError(
            f"{where}: shows its object in {len(seen)} of {len(ids)} pictures; expected at least {LEAST_VIEWS}: check "
            "that its masks are white where the object is, or remove the folder"
        )
    middle, size = _first_guess([(cameras[view], ids[view] == index) for view in seen])
    low, high = middle - ROOMY * size / 2, middle + ROOMY * size / 2
    cell, inside = (high - low) / (SIDE - 1), np.zeros((0, 3))
    for _ in range(2):
        cell = (high - low) / (SIDE - 1)
        points = low + np.argwhere(np.ones((SIDE,) * 3)) * cell
        inside = points[_is_inside(points, index, ids, cameras)]
        if not len(inside):
            raise HyalineError(
                f"{where}: its masks do not meet in space; check that they show one object, and that the cameras are "
                "those of the pictures"
            )
        low, high = inside.min(axis=0) - cell, inside.max(axis=0) + cell
    # Each grid point represents its cell; masks are least reliable at the outermost ones.
    low, high = np.percentile(inside, (0.4, 99.6), axis=0) + np.array([[-0.5], [0.5]]) * cell
    return Outline(name=name, center=tuple((low + high) / 2), radii=tuple((high - low) / 2))


def _first_guess(masks: Sequence[tuple[Camera, Bool[np.ndarray, "h w"]]]) -> tuple[Float[np.ndarray, "3"], float]:
    """The point nearest to the rays through the masks' middles, by the mean of its distance; and the size there."""
    from scipy.optimize import minimize

    place = np.stack([camera.world_from_camera[:3, 3] for camera, _ in masks])
    ahead = np.stack([camera.rays()[1][mask].mean(axis=0).astype(np.float64) for camera, mask in masks])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    sizes = [max(np.ptp(np.nonzero(mask), axis=1)) / camera.focal for camera, mask in masks]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    start = np.linalg.lstsq(across.sum(axis=0), np.einsum("vij,vj->i", across, place), rcond=None)[0]
    point = minimize(lambda p: np.linalg.norm(np.cross(p - place, ahead), axis=1).mean(), start, method="Powell").x
    return point, float(np.percentile(np.linalg.norm(point - place, axis=1) * sizes, 75))


def _is_inside(
    points: Float[np.ndarray, "point 3"], index: int, ids: Sequence[UInt8[np.ndarray, "h w"]], cameras: Cameras
) -> Bool[np.ndarray, " point"]:
    """Points that hardly any view denies."""
    yes, empty, views = (np.zeros(len(points), np.int32) for _ in range(3))
    for view, picture in enumerate(ids):
        shown, found = ids_at(points, picture, cameras[view])
        yes += shown & (found == index)
        empty += shown & (found == 0)
        views += shown
    return (yes >= LEAST_VIEWS) & (empty <= MAX_OUTSIDE * views) & (views - yes <= MAX_HIDDEN * views)


def ids_at(
    points: Float[np.ndarray, "point 3"], picture: UInt8[np.ndarray, "h w"], camera: Camera
) -> tuple[Bool[np.ndarray, " point"], UInt8[np.ndarray, " point"]]:
    """Whether points are in a camera's picture, and the ids of the pixels there; any id for the others."""
    pixel, depth = camera.project(points)
    column, row = np.floor(pixel).astype(np.int64).T
    shown = (depth > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return shown, picture[np.where(shown, row, 0), np.where(shown, column, 0)]


# Panes


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
    """The objects that are panes: upright boxes, by their masks, that are flat.

    Args:
        outlines: of all objects.
        ids: 1 + the place among the outlines of the object that each pixel sees, 0 elsewhere; one picture a camera.
    """
    first = np.stack(ids)
    sightings = Sightings(
        cameras=cameras,
        first=first,
        touched=first > 0,
        depth=np.full(first.shape, np.inf, np.float32),
        unknown=tuple(range(1, len(outlines) + 1)),
    )
    panes = []
    for object_id, outline in enumerate(outlines, start=1):
        box = fit_box(rays_near(sightings, object_id), np.array([0.0, 0.0, 1.0]))
        if box is None:
            continue
        half, angle = box.half_sizes.tolist(), float(np.arctan2(box.axes[0, 1], box.axes[0, 0]))
        if half[2] < MAX_THICKNESS * min(half[:2]):
            footprint = Rectangle(center=(box.center[0], box.center[1]), half=(half[0], half[1]), angle=angle)
            top = float(box.center[2] + half[2])
            panes.append(Pane(name=outline.name, footprint=footprint, top=top, thickness=2 * half[2]))
    return tuple(panes)
