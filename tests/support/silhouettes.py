"""Masks of simple solids in closed form, as cameras around them see them above a table."""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.cameras import Cameras, Lens, look_at
from datagen.data.meshes import Mesh, r2_steps
from hyaline_photos.fit.views import Sightings

Points = Float[np.ndarray, "ray 3"]
Meets = Callable[[Points, Points], Bool[np.ndarray, " ray"]]
"""Whether rays meet a solid, from their origins and directions."""


def sightings_of(meets: Meets, *, views: int = 40, size: int = 64, wrong: float = 0.0) -> Sightings:
    """One unknown object, with the id 1, above a table at z = 0, and nothing else.

    Args:
        wrong: share of the pixels beside an edge whose mask is wrong; every tenth mask is a pixel too wide, too.
    """
    rng = np.random.default_rng(0)
    cameras = views_around(views=views, size=size)
    masks, depths = [], []
    for view in range(views):
        origin, directions = (values.astype(np.float64) for values in cameras[view].rays())
        d = directions.reshape(-1, 3)
        mask = meets(np.broadcast_to(origin, d.shape), d).reshape(size, size)
        if wrong:
            mask = _spoilt(mask, rng, wrong, widened=view % 10 == 0)
        masks.append(mask)
        depths.append(np.where(directions[..., 2] < 0, -origin[2] / directions[..., 2], np.inf))
    seen = np.stack(masks)
    return Sightings(
        cameras=cameras,
        first=seen.astype(np.uint8),
        touched=seen,
        depth=np.stack(depths).astype(np.float32),
        unknown=(1,),
    )


def views_around(*, views: int, size: int) -> Cameras:
    """Square views from around and above of what stands at the origin."""
    around, up = (r2_steps(views) % 1).T
    azimuth, sine = 2 * np.pi * around, 0.15 + 0.75 * up
    direction = np.stack([np.cos(azimuth), np.sin(azimuth), sine / np.sqrt(1 - sine**2)], axis=1)
    places = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    aims = np.array([0, 0, 0.05]) + np.random.default_rng(0).uniform(-0.03, 0.03, (views, 3))
    return Lens(fov_x=math.radians(22), width=size, height=size).cameras(
        np.stack([look_at(place, aim) for place, aim in zip(places, aims)])
    )


def ball(center: tuple[float, float, float], radius: float) -> Meets:
    """A ball."""

    def meets(o: Points, d: Points) -> Bool[np.ndarray, " ray"]:
        return np.linalg.norm(np.cross(np.array(center) - o, d), axis=1) < radius

    return meets


def block(center: tuple[float, float, float], half_sizes: tuple[float, float, float], turn: np.ndarray) -> Meets:
    """A box with sharp edges, turned by a rotation matrix, by the slabs between its opposite sides."""

    def meets(o: Points, d: Points) -> Bool[np.ndarray, " ray"]:
        o, d = (o - center) @ turn, d @ turn
        ends = np.stack([(side * np.array(half_sizes) - o) / d for side in (-1, 1)])
        return ends.min(axis=0).max(axis=1) < ends.max(axis=0).min(axis=1)

    return meets


def cylinder(radius: float, low: float, high: float) -> Meets:
    """An upright cylinder around the z axis."""

    def meets(o: Points, d: Points) -> Bool[np.ndarray, " ray"]:
        a, b = (d[:, :2] ** 2).sum(axis=1), (o[:, :2] * d[:, :2]).sum(axis=1)
        inside = b**2 - a * ((o[:, :2] ** 2).sum(axis=1) - radius**2)
        root = np.sqrt(np.maximum(inside, 0))
        enter, leave = np.sort((np.array([[low], [high]]) - o[:, 2]) / d[:, 2], axis=0)
        return (inside > 0) & (np.maximum((-b - root) / a, enter) < np.minimum((-b + root) / a, leave))

    return meets


def either(*solids: Meets) -> Meets:
    """The union of solids."""
    return lambda o, d: np.any([meets(o, d) for meets in solids], axis=0)


def traced(mesh: Mesh) -> Meets:
    """A solid by its mesh."""
    from datagen.trace.peel import Peeler

    peeler = Peeler((mesh,))
    return lambda o, d: peeler.trace(o.astype(np.float32), d.astype(np.float32), 1).shape[0] >= 0


def _spoilt(
    mask: Bool[np.ndarray, "h w"], rng: np.random.Generator, share: float, *, widened: bool
) -> Bool[np.ndarray, "h w"]:
    from scipy import ndimage

    wide = np.asarray(ndimage.binary_dilation(mask))
    edge = wide & ~np.asarray(ndimage.binary_erosion(mask), bool)
    return (wide if widened else mask) ^ (edge & (rng.random(mask.shape) < share))
