"""Places of glass objects: upright ellipsoids around the intersection of their masks' cones.

They replace the true meshes until `model fit` finds these.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from datagen.data.cameras import Camera, Cameras
from datagen.disk.errors import HyalineError

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


@dataclass(frozen=True, kw_only=True)
class Outline:
    """An upright ellipsoid."""

    name: str
    center: tuple[float, float, float]
    radii: tuple[float, float, float]

    def around(self, points: Float[np.ndarray, "point 3"], *, times: float) -> Bool[np.ndarray, " point"]:
        """True for points in the ellipsoid after scaling it by a factor."""
        return (((points - self.center) / (times * np.array(self.radii))) ** 2).sum(axis=1) < 1

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
        points = _grid(low, high)
        cell, inside = (high - low) / (SIDE - 1), points[_is_inside(points, index, ids, cameras)]
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
    """The point nearest to the rays through the masks' middles, by the median of its distance; and the size there."""
    origins, directions, angles = [], [], []
    for camera, mask in masks:
        rows, columns = np.nonzero(mask)
        _, rays = camera.rays()
        middle = rays[rows, columns].mean(axis=0).astype(np.float64)
        origins.append(camera.world_from_camera[:3, 3])
        directions.append(middle / np.linalg.norm(middle))
        angles.append(max(np.ptp(rows), np.ptp(columns)) / camera.focal)
    place, ahead = np.array(origins), np.array(directions)
    weight, point = np.ones(len(place)), place.mean(axis=0)
    for _ in range(10):
        across = weight[:, None, None] * (np.eye(3) - ahead[:, :, None] * ahead[:, None, :])
        point = np.linalg.lstsq(across.sum(axis=0), np.einsum("vij,vj->i", across, place), rcond=None)[0]
        away = point - place
        off = np.linalg.norm(away - (away * ahead).sum(axis=1, keepdims=True) * ahead, axis=1)
        weight = 1 / (off + 1e-3 * np.median(np.linalg.norm(away, axis=1)))
    return point, float(np.percentile(np.linalg.norm(point - place, axis=1) * np.array(angles), 75))


def _grid(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> Float[np.ndarray, "point 3"]:
    axes = [np.linspace(a, b, SIDE) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


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
