"""Masks of unknown objects in the training views, and the known surfaces behind them."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, UInt8
from scipy import ndimage, special

from datagen.data.cameras import Cameras
from datagen.data.dataset import Dataset, View, has_layers
from datagen.data.meshes import Mesh, is_there, no_mesh
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import Scene
from datagen.scene.materials import ThinDielectric
from datagen.terminal.command import choose

DOUBT = 3
"""Largest error in pixels of the outlines of known surfaces, where masks are not exact."""
MOST_OVERRULED = 0.25
"""Largest share of the views that others overrule."""
DENIED = 0.003
"""Share of the rays through masks for which an overruled view leaves no room. Of 74 photographs, the 13 in which a toy
hid the foot of a glass left none for 1.1 to 4.2 %, each of the others for less than 0.1 %."""
HIDES = 255
"""Id of whatever hides a convex object."""
MARGIN = 4
"""Pixels around a mask whose rays bound the object; those farther out bound it less."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sightings:
    """First hits of the rays through the pixel centres of all training views."""

    cameras: Cameras
    first: UInt8[np.ndarray, "view h w"]
    """Id of the unknown object that the ray meets first; 0 where it meets another surface first, or none."""
    touched: Bool[np.ndarray, "view h w"]
    """The straight ray meets an unknown object somewhere, perhaps behind other glass."""
    depth: Float32[np.ndarray, "view h w"]
    """Metres along the ray to the first surface of known shape; infinite where there is none."""
    unknown: tuple[int, ...]
    """Ids of the objects of unknown shape."""
    found: tuple[Mesh, ...] = ()
    """Objects whose shapes were unknown and are found (`with_known`)."""

    def rays(self) -> tuple[Float32[np.ndarray, "view 3"], Float32[np.ndarray, "view h w 3"]]:
        """Origins and unit directions."""
        pairs = [self.cameras[view].rays() for view in range(len(self.cameras))]
        return np.stack([origin for origin, _ in pairs]), np.stack([directions for _, directions in pairs])

    def sees(self, object_id: int) -> Bool[np.ndarray, "view h w"]:
        return self.first == object_id

    def is_open(self, object_id: int) -> Bool[np.ndarray, "view h w"]:
        """True where no other unknown object hides this one."""
        return ~np.isin(self.first, [other for other in self.unknown if other != object_id])


def find_unknown(dataset: Dataset, scene: Scene, names: tuple[str, ...]) -> tuple[int, ...]:
    """Ids of the objects of these names, or of all glass but thin panes, which are neither solid nor vessels."""
    for name in names:
        choose("--unknown: object", name, [item.name for item in dataset.objects])
        if not next(item.is_glass for item in dataset.objects if item.name == name):
            raise HyalineError(f"unknown {name!r}: is opaque; only glass is fitted")
    thin = {item.name for item in scene.objects if isinstance(item.material, ThinDielectric)}
    there = {item.name for item in scene.objects if is_there(item.mesh)}
    fitted = names or [item.name for item in dataset.objects if item.is_glass and item.name in there - thin]
    if not fitted:
        raise HyalineError(f"{dataset.root}: has no glass but thin panes; expected solid glass or vessels to fit")
    return tuple(place for place, item in enumerate(dataset.objects, start=1) if item.name in fitted)


def read_sightings(
    dataset: Dataset, meshes: tuple[Mesh, ...], unknown: tuple[int, ...], *, is_exact: bool
) -> Sightings:
    """Reads the masks of the training views, and traces the known surfaces.

    Args:
        meshes: of all objects; those of unknown ones are not looked at.
        is_exact: masks and known surfaces are; otherwise depths are `doubted`.
    """
    use_mitsuba()
    from datagen.trace.peel import Peeler

    known = known_meshes(meshes, unknown)
    peeler = Peeler(known) if any(map(is_there, known)) else None
    first, touched, depth = [], [], []
    for view in dataset.views("train"):
        seen, anywhere = _read_masks(dataset, view, unknown)
        first.append(seen)
        touched.append(anywhere)
        depth.append(np.full(seen.shape, np.inf, np.float32))
        if peeler is not None:
            origin, directions = view.camera.rays()
            hits = peeler.trace(origin, directions.reshape(-1, 3), 1)
            depth[-1] = np.where(hits.shape[0] >= 0, hits.t[0], np.inf).reshape(seen.shape).astype(np.float32)
    return Sightings(
        cameras=dataset.cameras("train"),
        first=np.stack(first),
        touched=np.stack(touched),
        depth=np.stack(depth) if is_exact else doubted(np.stack(depth), np.stack(first)),
        unknown=unknown,
    )


def with_known(sightings: Sightings, object_id: int, mesh: Mesh) -> Sightings:
    """The same with an object whose shape is known now: the others that its pixels do not show end before it."""
    from datagen.trace.peel import Peeler

    peeler, depth = Peeler((mesh,)), sightings.depth.copy()
    for view, shows in enumerate(sightings.sees(object_id)):
        origin, directions = sightings.cameras[view].rays()
        hits = peeler.trace(origin, directions[shows], 1)
        # Beside the mesh, nothing is known of what the pixel's ray meets.
        depth[view, shows] = np.where(hits.shape[0] >= 0, np.minimum(hits.t[0], depth[view, shows]), 0)
    seen = sightings.sees(object_id)
    return dataclasses.replace(
        sightings,
        first=np.where(seen, 0, sightings.first).astype(np.uint8),
        depth=depth,
        unknown=tuple(each for each in sightings.unknown if each != object_id),
        found=(*sightings.found, mesh),
    )


def without_views(sightings: Sightings, object_id: int, views: Int[np.ndarray, " left_out"]) -> Sightings:
    """The same where some views do not show an object, and so say nothing of its outline."""
    first = sightings.first.copy()
    first[views] = np.where(first[views] == object_id, 0, first[views])
    return dataclasses.replace(sightings, first=first)


def as_convex(sightings: Sightings, object_id: int) -> Sightings:
    """The same where the object is convex: what dents its silhouettes hides it."""
    from skimage.morphology import convex_hull_image

    first, sees = sightings.first.copy(), sightings.sees(object_id)
    for view in np.flatnonzero(sees.any(axis=(1, 2))):
        first[view][np.asarray(convex_hull_image(sees[view])) & ~sees[view]] = HIDES
    return dataclasses.replace(sightings, first=first, unknown=(*sightings.unknown, HIDES))


def doubted(
    depth: Float32[np.ndarray, "view h w"], first: UInt8[np.ndarray, "view h w"]
) -> Float32[np.ndarray, "view h w"]:
    """Depths of known surfaces whose outlines may be wrong.

    A ray that misses all unknown objects says nothing behind the nearest surface within `DOUBT` pixels. One that sees
    an unknown object is not stopped by a surface, which may stand out too far.
    """
    nearest = ndimage.minimum_filter(depth, size=(1, 2 * DOUBT + 1, 2 * DOUBT + 1))
    return np.where(first > 0, np.float32(np.inf), nearest)


def height_below(
    surfaces: tuple[Mesh, ...], up: Float64[np.ndarray, "3"], point: Float64[np.ndarray, "3"], reach: float
) -> float | None:
    """Height along `up` of the first surface straight below a point, up to `reach` above it; None if farther below."""
    from datagen.trace.peel import Peeler

    if not any(map(is_there, surfaces)):
        return None
    start = point + reach * up
    hits = Peeler(surfaces).trace(start.astype(np.float32)[None], -up.astype(np.float32)[None], 1)
    is_near = hits.shape[0, 0] >= 0 and hits.t[0, 0] < 2 * reach
    return float(start @ up - hits.t[0, 0]) if is_near else None


def known_meshes(meshes: tuple[Mesh, ...], unknown: Sequence[int]) -> tuple[Mesh, ...]:
    """The meshes without those of the unknown objects."""
    return tuple(no_mesh() if place + 1 in unknown else mesh for place, mesh in enumerate(meshes))


def _read_masks(dataset: Dataset, view: View, unknown: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """`first` and `touched` of a view, from the dataset's own masks."""
    if (given := view.imported_object_ids) is not None:
        seen = np.where(np.isin(given, unknown), given, 0).astype(np.uint8)
        return seen, seen > 0
    if has_layers(dataset):
        ids = view.object_ids()
        is_unknown = np.isin(ids, unknown)
        return np.where(is_unknown[0], ids[0], 0).astype(np.uint8), np.asarray(is_unknown.any(axis=0))
    if len(unknown) == 1 and (mask := view.imported_mask) is not None:
        return np.where(mask, unknown[0], 0).astype(np.uint8), np.asarray(mask)
    raise HyalineError(
        f"{dataset.root}: its pictures have no masks of single objects; expected a dataset of `datagen build`, or "
        "of `datagen capture` with a mask for each object"
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class NearRays:
    """The rays through one object's mask and close by."""

    origins: Float64[np.ndarray, "ray 3"]
    directions: Float64[np.ndarray, "ray 3"]
    hits: Bool[np.ndarray, " ray"]
    """The ray meets the object; others miss it, at least up to `reach`."""
    reach: Float64[np.ndarray, " ray"]
    """Metres up to the first known surface."""
    view: np.ndarray
    is_edge: Bool[np.ndarray, " ray"]
    """Within 2 pixels of where the mask begins."""
    pixel_angle: float
    """Radians between the rays of neighbouring pixels."""

    def at(self, t: Float64[np.ndarray, "ray *place"]) -> Float64[np.ndarray, "ray *place 3"]:
        """Points this many metres along the rays."""
        origins, directions = (each.reshape(-1, *(1,) * (t.ndim - 1), 3) for each in (self.origins, self.directions))
        return origins + t[..., None] * directions

    def only(self, kept: slice | Bool[np.ndarray, " ray"] | Int[np.ndarray, " kept"]) -> "NearRays":
        """Some of the rays."""
        rays = {name: value[kept] for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        return dataclasses.replace(self, **rays)

    def thinned(self, most: int) -> "NearRays":
        """At most about this many rays, evenly spread."""
        return self.only(slice(None, None, max(1, round(len(self.hits) / most))))

    def at_edges(self) -> "NearRays":
        """The rays at the edges alone: those farther in or out say little of where the object is."""
        return self.only(self.is_edge)


def rays_near(sightings: Sightings, object_id: int) -> NearRays:
    """Rays in and around the mask of one object, except where another object may hide it."""
    sees = sightings.sees(object_id)
    disc = np.hypot(*np.mgrid[-MARGIN : MARGIN + 1, -MARGIN : MARGIN + 1]) <= MARGIN
    near = ndimage.binary_dilation(sees, disc[None]) & sightings.is_open(object_id)
    beside = ndimage.generate_binary_structure(2, 2)[None]
    wide = np.asarray(ndimage.binary_dilation(sees, beside, iterations=2), bool)
    # An object goes on beyond the picture's border, which is no edge of it.
    narrow = np.asarray(ndimage.binary_erosion(sees, beside, iterations=2, border_value=1), bool)
    return rays_of(sightings, near, sees, wide & ~narrow)


def rays_of(
    sightings: Sightings,
    chosen: Bool[np.ndarray, "view h w"],
    hits: Bool[np.ndarray, "view h w"],
    is_edge: Bool[np.ndarray, "view h w"],
) -> NearRays:
    """The rays of some pixels."""
    origins, directions = sightings.rays()
    view = np.nonzero(chosen)[0]
    return NearRays(
        origins=origins[view].astype(np.float64),
        directions=directions[chosen].astype(np.float64),
        hits=hits[chosen],
        reach=sightings.depth[chosen].astype(np.float64),
        view=view,
        is_edge=is_edge[chosen],
        pixel_angle=1 / sightings.cameras.focal,
    )


# How well a shape agrees with masks: each ray at a mask's edge is one sample of a logistic regression

WRONG_PIXELS = 0.01
"""Expected share of wrong pixels at a mask's edge; pixels that a shape cannot explain have little say."""


def misfits(
    distance: Float64[np.ndarray, " ray"], hits: Bool[np.ndarray, " ray"], width: float | Float[np.ndarray, " ray"]
) -> Float64[np.ndarray, " ray"]:
    """Negative logarithm of the likelihood of each ray's mask.

    Args:
        distance: least signed distance in metres from the shape along each ray, negative inside.
        hits: whether the mask covers the ray.
        width: metres over which a ray turns from meeting the shape to missing it.
    """
    right = special.expit(np.where(hits, -distance, distance) / width)
    return -np.log(WRONG_PIXELS + (1 - 2 * WRONG_PIXELS) * right)


def pull(
    distance: Float64[np.ndarray, " ray"], hits: Bool[np.ndarray, " ray"], width: float | Float[np.ndarray, " ray"]
) -> tuple[Float64[np.ndarray, " ray"], Float64[np.ndarray, " ray"]]:
    """First and second derivatives of `misfits` by the distance.

    Far away the second is an upper bound, where Newton's steps would be too long.
    """
    error = np.where(hits, distance, -distance) / width
    wrong = special.expit(error)
    # Of pixels on the wrong side by much, the mask is in doubt, not the shape.
    trust = (1 - WRONG_PIXELS) * (1 - wrong) / (WRONG_PIXELS + (1 - 2 * WRONG_PIXELS) * (1 - wrong))
    bound = np.where(error > 1e-3, (wrong - 0.5) / np.maximum(error, 1e-3), wrong * (1 - wrong))
    return np.where(hits, 1, -1) * trust * wrong / width, trust * bound / width**2


def closest(
    distance: Callable[[Float64[np.ndarray, "ray place"]], Float64[np.ndarray, "ray place"]],
    low: Float64[np.ndarray, " ray"],
    high: Float64[np.ndarray, " ray"],
    counts: Sequence[int],
) -> Float64[np.ndarray, " ray"]:
    """Metres along rays at which a distance is least.

    Args:
        distance: at places along each ray, by these metres.
        low: where the search begins.
        high: where it ends.
        counts: places at which each ray is looked at, first between both ends, then around the best place.
    """
    found, row = low, np.arange(len(low))
    for count in counts:
        t = np.linspace(low, high, count, axis=1)
        best = distance(t).argmin(axis=1)
        low, found, high = (t[row, np.clip(best + side, 0, count - 1)] for side in (-1, 0, 1))
    return found


def outvoted(told: Float[np.ndarray, "view ray place"]) -> Int[np.ndarray, " overruled"]:
    """Views whose masks lack parts of the object that the other views show, for instance because something hides them.

    Views are believed one after the other, beginning with those that deny the least. One that would leave no room for
    the object along some rays through masks is overruled. A view that alone sees past a rim leaves room below it.

    Args:
        told: how far inside the object places along such rays may be by each view, in metres; negative outside.
    """
    most = int(MOST_OVERRULED * len(told))
    inside = np.partition(told, most, axis=0)[most]

    def denied(each: Float[np.ndarray, "ray place"]) -> float:
        return float(((inside > 0).any(axis=1) & ~(np.minimum(inside, each) > 0).any(axis=1)).mean())

    overruled = []
    for view in np.argsort([denied(each) for each in told], stable=True):
        if denied(told[view]) > DENIED and len(overruled) < most:
            overruled.append(view)
        else:
            inside = np.minimum(inside, told[view])
    return np.sort(np.array(overruled, int))


def unexplained(mesh: Mesh, rays: NearRays) -> float:
    """Share of the rays at a mask's edge that meet a mesh and should miss it, or the other way round.

    Where the mask shows the object, a known surface in front of it is misplaced, and does not count.
    """
    from datagen.trace.peel import Peeler

    edge = rays.at_edges()
    hits = Peeler((mesh,)).trace(edge.origins.astype(np.float32), edge.directions.astype(np.float32), 1)
    meets = (hits.shape[0] >= 0) & (edge.hits | (hits.t[0] < edge.reach))
    return float((meets != edge.hits).mean())
