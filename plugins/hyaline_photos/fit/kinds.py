"""Which kind of shape an object has: the one whose silhouettes differ least from its masks."""

import dataclasses
import functools
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float64

from datagen.data.dataset import Dataset
from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.terminal.command import say
from hyaline_photos.fit.boxes import Box, fit_box, outline_of
from hyaline_photos.fit.drinks import find_holders
from hyaline_photos.fit.handles import with_handles, without_handles
from hyaline_photos.fit.hull import SMOOTH, Carved, HullShape, carve
from hyaline_photos.fit.lathe import Axis, perpendicular
from hyaline_photos.fit.outlines import find_ball, find_outside, find_solid
from hyaline_photos.fit.outside import Hull, find_center, find_hull, find_section, hull_about
from hyaline_photos.fit.profiles import between_rays
from hyaline_photos.fit.section import guess_section
from hyaline_photos.fit.shapes import Glass, Revolution
from hyaline_photos.fit.silhouettes import unexplained
from hyaline_photos.fit.views import NearRays, Sightings, rays_near

STANDS = 0.1
"""Largest gap between an object's lowest point, as masks show it, and its support, relative to its radius."""

GAP = 0.01
"""Gap between an object and its support, relative to its radius. Without a gap, rays hit either of the coinciding
surfaces at random."""

UPRIGHT = 0.97
"""Cosine between an axis and up from which it has been searched before."""

SIDE = 0.5
"""Largest cosine between the axis and the normals of a side."""

LEVELS, ANGLES = 20, 72
"""At which a side's distances from the axis are compared."""

MIDDLE = (0.2, 0.8)
"""Quantiles of the heights between which a side is looked at."""

StandsOn = Callable[[Float64[np.ndarray, "3"], float], float | None]
"""Height along up of a known surface no farther than this above or below a point; None: there is none."""

LEAST_DEPTH = 0.5
"""Least height of a box that may be a vessel, over half its smaller width; panes and table tops are none."""

LEAST_VIEWS = 3
"""Training pictures that must show an object first; fewer never give its shape."""

GOOD, GOOD_FOR_WRONG_MASKS = 0.012, 0.03
"""Share of edge pixels that a shape may get wrong before other kinds are tried; where masks may be wrong, too."""

BALL, OUTLINE, HULL = 0.0, 1.0, 3.0
"""Complexity of a ball, of a box or an outline about an axis, and of a hull."""

SIMPLER = 0.006
"""Share of edge pixels that a unit of complexity has to explain."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Outside:
    """An outside, and how well it explains the masks."""

    glass: Glass
    unexplained: float
    """Share of the rays at the mask's edge that meet the shape and should miss it, or the other way round."""
    complexity: float

    @property
    def cost(self) -> float:
        return self.unexplained + self.complexity * SIMPLER


def find_shown(sightings: Sightings, mask_errors: int) -> tuple[int, ...]:
    """Ids of the unknown objects whose outside pictures show: enough views see it first, and rays pass beside it."""
    holders = find_holders(sightings)

    def is_shown(object_id: int) -> bool:
        if sightings.sees(object_id).any(axis=(1, 2)).sum() < LEAST_VIEWS:
            return False
        if object_id in holders or object_id in holders.values():
            return True  # The rays beside a drink meet its vessel.
        edge = rays_near(sightings, object_id).at_edges()
        return bool(edge.hits.any() and (~edge.hits).sum() > mask_errors)

    return tuple(filter(is_shown, sightings.unknown))


def choose_shown(dataset: Dataset, sightings: Sightings, *, mask_errors: int, must_be_all: bool) -> tuple[int, ...]:
    """Ids of the unknown objects whose shape pictures show; the others cannot be fitted.

    Args:
        must_be_all: refuse objects that pictures do not show well enough, instead of taking them as known.
    """
    shown = find_shown(sightings, mask_errors)
    hidden = [dataset.objects[each - 1].name for each in sightings.unknown if each not in shown]
    names, needs = ", ".join(hidden), f"{LEAST_VIEWS} training pictures must show an object first, and one its edge"
    if not shown:
        raise HyalineError(f"{dataset.root}: nothing to fit: pictures do not show the outside of {names}; {needs}")
    if hidden and must_be_all:
        raise HyalineError(
            f"{dataset.root}: pictures do not show the outside of {names}; {needs}. Objects left out of "
            "--unknown are taken as known"
        )
    if hidden:
        say(f"taken as known, because pictures do not show their outside: {names}")
    return shown


def choose_outside(
    sightings: Sightings, object_id: int, up: Float64[np.ndarray, "3"], *, mask_errors: int, stands_on: StandsOn
) -> Outside:
    """The outside of one object.

    Raises:
        HyalineError: the masks do not show it.
    """
    rays = rays_near(sightings, object_id)
    hull = find_hull(rays, up, order=mask_errors)
    support = _support(hull, stands_on)
    evidence = _Evidence(rays=rays, up=up, support=support, mask_errors=mask_errors, stands_on=stands_on)
    carved = functools.cache(lambda: carve(sightings, object_id, up, support))
    found = [_judged(rays, *each) for each in _round(evidence, hull)]
    good = GOOD_FOR_WRONG_MASKS if mask_errors else GOOD
    if min((each.unexplained for each in found), default=1.0) > good:
        for kind in _others(evidence, hull, carved):
            judged = [_judged(rays, *each) for each in kind]
            found += judged
            if any(each.complexity < HULL and each.unexplained < good for each in judged):
                break
    if not found:
        raise HyalineError("masks do not show its shape: too few pixels see it, or no point is inside all masks")
    best = min(found, key=lambda each: each.cost)
    if isinstance(best.glass, HullShape):
        return _judged(rays, HULL, carved().smoothed().unwrapped())
    return _with_opening(evidence, best, best.glass) if isinstance(best.glass, Box) else best


def _judged(rays: NearRays, complexity: float, glass: Glass) -> Outside:
    return Outside(glass=glass, unexplained=unexplained(glass.mesh(), rays), complexity=complexity)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Evidence:
    """What is known of an object's shape."""

    rays: NearRays
    up: Float64[np.ndarray, "3"]
    support: float | None
    """Height along `up` of the known surface below it, if there is one."""
    mask_errors: int
    stands_on: StandsOn

    def bottom(self) -> float | None:
        """Height along `up` where it ends: at its support, or else above the known surface below its middle."""
        if self.support is not None:
            return self.support
        middle, radius = find_center(self.rays)
        height = self.stands_on(middle - radius * self.up, radius)
        return None if height is None else height + GAP * radius

    def along(self, axis: Axis) -> float | None:
        """The support's height along an axis; None about one that lies."""
        upright = float(axis.direction @ self.up)
        if self.support is None or upright < UPRIGHT:
            return None
        return float((self.support - axis.point @ self.up) / upright)


def _round(evidence: _Evidence, hull: Hull) -> list[tuple[float, Glass]]:
    """Ball and outlines about one axis, with their complexity."""
    ball = find_ball(hull) if hull.around is None else None
    found: list[tuple[float, Glass]] = [] if ball is None else [(BALL, ball)]
    fitted, support = between_rays(hull, evidence.rays), evidence.along(hull.axis)
    outside, solid = find_outside(fitted, support), find_solid(fitted, support)
    if solid is not None and (outside is None or not solid.has_flat_top):
        return [*found, (OUTLINE, solid)]
    if outside is not None and solid is not None:
        return [*found, (OUTLINE, dataclasses.replace(outside, solid=solid.solid, numbers=solid.numbers))]
    return [*found, (OUTLINE, outside)] if outside is not None else found


def _others(evidence: _Evidence, hull: Hull, carved: Callable[[], Carved]) -> Iterator[list[tuple[float, Glass]]]:
    """Box, hull of any shape, outlines about other sections and axes, and vessel with handles."""
    box = fit_box(evidence.rays, evidence.up, evidence.bottom())
    if box is not None:
        yield [(OUTLINE, box)]
    try:
        shape = carved().smoothed(SMOOTH[:1])
    except HyalineError:
        return  # Nothing is inside all masks.
    yield [(HULL, shape)]
    center, axes = _inertia_of(shape)
    for direction in (evidence.up, *axes[np.abs(axes @ evidence.up) < UPRIGHT]):
        if direction is not evidence.up:
            yield _round(evidence, find_hull(evidence.rays, direction, order=evidence.mask_errors))
        yield _with_corners(evidence, Axis(point=center, direction=direction), shape)
    vessel = _vessel_with_handles(evidence, hull, shape)
    if vessel is not None:
        yield [(OUTLINE, vessel)]


def _with_opening(evidence: _Evidence, best: Outside, box: Box) -> Outside:
    """An upright box as an outline that may be a vessel's; the box where that explains masks less."""
    if box.axes[2] @ evidence.up < UPRIGHT or 2 * box.half_sizes[2] < LEAST_DEPTH * box.half_sizes[:2].min():
        return best
    outline = _judged(evidence.rays, best.complexity, outline_of(box))
    return outline if outline.unexplained < best.unexplained + SIMPLER else best


def _with_corners(evidence: _Evidence, axis: Axis, shape: HullShape) -> list[tuple[float, Glass]]:
    """Outlines about a polygon, if the hull of any shape looks like one about this axis."""
    section = guess_section(*_radii_around(shape.surface, axis))
    if section is None:
        return []
    return _round(evidence, find_section(evidence.rays, axis, section, order=evidence.mask_errors))


def _radii_around(mesh: Mesh, axis: Axis) -> tuple[Float64[np.ndarray, " angle"], Float64[np.ndarray, " angle"]]:
    """How far a mesh's side is from an axis in each direction, relative to the median at that height."""
    u, v = perpendicular(axis.direction)
    relative = (mesh.vertices - axis.point) @ np.stack([u, v, axis.direction], axis=1)
    height, low, high = relative[:, 2], *np.quantile(relative[:, 2], MIDDLE)
    is_side = (height > low) & (height < high) & (np.abs(mesh.normals @ axis.direction) < SIDE)
    radius, angle = np.hypot(*relative[is_side, :2].T), np.arctan2(relative[is_side, 1], relative[is_side, 0])
    level = ((height[is_side] - low) / (high - low) * LEVELS).astype(int)
    for each in np.unique(level):
        radius[level == each] /= np.median(radius[level == each])
    angles = (np.arange(ANGLES) + 0.5) * (2 * np.pi / ANGLES) - np.pi
    place = np.minimum(((angle + np.pi) / (2 * np.pi) * ANGLES).astype(int), ANGLES - 1)
    seen = np.unique(place)
    if len(seen) < ANGLES / 2:
        return angles, np.ones(ANGLES)
    medians = [np.median(radius[place == each]) for each in seen]
    return angles, np.interp(angles, angles[seen], medians, period=2 * np.pi)


def _inertia_of(shape: HullShape) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3 3"]]:
    """Centre of mass, and the principal axes, one a row."""
    import trimesh

    solid = trimesh.Trimesh(shape.surface.vertices, shape.surface.faces, process=False)
    return np.asarray(solid.center_mass, np.float64), np.asarray(solid.principal_inertia_vectors, np.float64)


def _vessel_with_handles(evidence: _Evidence, hull: Hull, shape: HullShape) -> Revolution | None:
    outside = find_outside(hull, evidence.along(hull.axis))
    if outside is None or outside.is_closed:
        return None
    beside = without_handles(evidence.rays, outside.hollowed(0.08, 0.1, 0.3), shape)
    if not (~beside.hits).any() or not beside.hits.any():
        return None
    bare = find_outside(
        between_rays(hull_about(beside, hull.axis, hull.heights, order=0), beside), evidence.along(hull.axis)
    )
    return None if bare is None or bare.is_closed else with_handles(bare.hollowed(0.08, 0.1, 0.3), shape.unwrapped())


def _support(hull: Hull, stands_on: StandsOn) -> float | None:
    """Height along `up` of an object's support, plus the gap."""
    if not hull.radii.any():
        return None
    lowest, radius = hull.heights[hull.radii > 0][0], float(hull.radii.max())
    height = stands_on(hull.axis.point + lowest * hull.axis.direction, STANDS * radius)
    return None if height is None else height + GAP * radius
