"""Tests outsides from masks on silhouettes that are known in closed form, some pixels of which are wrong."""

import dataclasses

import numpy as np
import pytest

from datagen.data.cameras import Cameras, look_at
from datagen.machine.mitsuba_variant import use_mitsuba
from hyaline_photos.fit.boxes import Box
from hyaline_photos.fit.outside import Hull, find_ball, find_hull, find_outside, find_solid, hull_about
from hyaline_photos.fit.shapes import Axis
from hyaline_photos.fit.views import NearRays, Sightings, doubted, height_below, rays_near, with_known

UP = np.array([0.0, 0.0, 1.0])
CENTER = np.array([0.02, -0.01, 0.05])
VIEWS, SIZE = 12, 64


def cameras() -> Cameras:
    angles = np.arange(VIEWS) * 2.4
    heights = 0.12 + 0.5 * (np.arange(VIEWS) % 5) / 5
    places = np.stack([0.7 * np.cos(angles), 0.7 * np.sin(angles), heights], axis=1)
    return Cameras(
        world_from_camera=np.stack([look_at(place, CENTER) for place in places]),
        fov_x=2 * np.arctan(SIZE / 2 / 220),
        width=SIZE,
        height=SIZE,
    )


def sightings_of(mask: np.ndarray, taken: Cameras) -> Sightings:
    return Sightings(
        cameras=taken,
        first=mask.astype(np.uint8),
        touched=mask,
        depth=np.full(mask.shape, np.inf, np.float32),
        unknown=(1,),
    )


def all_rays(taken: Cameras) -> tuple[np.ndarray, np.ndarray]:
    pairs = [taken[view].rays() for view in range(VIEWS)]
    return np.stack([origin for origin, _ in pairs])[:, None, None], np.stack([directions for _, directions in pairs])


def ball_mask(taken: Cameras, radius: float) -> np.ndarray:
    o, d = all_rays(taken)
    return np.linalg.norm(np.cross(CENTER - o, d), axis=-1) < radius


def ellipsoid_mask(taken: Cameras, radius: float, half_height: float) -> np.ndarray:
    """Rays that meet an upright ellipsoid: a ball, once heights are scaled."""
    o, d = all_rays(taken)
    scale = np.array([1, 1, radius / half_height])
    o, d = (CENTER - o) * scale, d * scale
    return np.linalg.norm(np.cross(o, d), axis=-1) < radius * np.linalg.norm(d, axis=-1)


def cone_mask(taken: Cameras, low: float, high: float, height: float) -> np.ndarray:
    """Rays that meet an upright cut cone on the plane z = 0: in its side, or in one of its ends."""
    o, d = all_rays(taken)
    o = o - [CENTER[0], CENTER[1], 0]
    slope = (high - low) / height

    def radius(z: np.ndarray) -> np.ndarray:
        return low + slope * z

    # |o + t d| across = radius(z), a quadratic equation in t.
    a = (d[..., :2] ** 2).sum(-1) - (slope * d[..., 2]) ** 2
    b = (o[..., :2] * d[..., :2]).sum(-1) - slope * d[..., 2] * radius(o[..., 2])
    c = (o[..., :2] ** 2).sum(-1) - radius(o[..., 2]) ** 2
    root = np.sqrt(np.maximum(b**2 - a * c, 0))
    met = np.zeros(d.shape[:3], bool)
    for t in ((-b - root) / a, (-b + root) / a):
        z = o[..., 2] + t * d[..., 2]
        met |= (b**2 > a * c) & (z >= 0) & (z <= height) & (radius(z) >= 0)
    for end in (0.0, height):
        p = o + ((end - o[..., 2]) / d[..., 2])[..., None] * d
        met |= np.linalg.norm(p[..., :2], axis=-1) < radius(np.array(end))
    return met


def wrong_at_edges(mask: np.ndarray, share: float) -> np.ndarray:
    """The mask with some of its outermost pixels missing."""
    inner = mask.copy()
    for axis in (1, 2):
        for step in (1, -1):
            inner &= np.roll(mask, step, axis=axis)
    edge = mask & ~inner
    return mask & ~(edge & (np.random.default_rng(0).random(mask.shape) < share))


def hull_of_cone(low: float, high: float, height: float) -> Hull:
    """Of the exact masks of an upright cut cone."""
    taken = cameras()
    return find_hull(rays_near(sightings_of(cone_mask(taken, low, high, height), taken), 1), UP, order=0)


def upright_hull(heights: np.ndarray, radii: np.ndarray) -> Hull:
    """Of exact masks, about the z axis."""
    axis = Axis(point=np.zeros(3), direction=UP)
    return Hull(axis=axis, heights=heights, radii=radii, bounds=radii, unexplained=0.0, is_exact=True)


def test_a_ball_is_found_to_a_fraction_of_a_millimetre() -> None:
    taken = cameras()
    rays = rays_near(sightings_of(ball_mask(taken, 0.045), taken), 1)
    hull = hull_about(rays, Axis(point=CENTER, direction=UP), np.linspace(-0.06, 0.06, 241), order=0)
    found = find_ball(hull)
    assert found is not None
    assert found.kind == "ball"
    middle = found.axis.point + found.outside[:, 1].mean() * found.axis.direction
    assert np.linalg.norm(middle - CENTER) < 0.0005
    assert found.height / 2 == pytest.approx(0.045, abs=0.0003)


def test_a_cut_cone_is_found_even_if_some_mask_pixels_are_wrong() -> None:
    low, high, height = 0.03, 0.045, 0.11
    taken = cameras()
    mask = wrong_at_edges(cone_mask(taken, low, high, height), 0.02)
    hull = find_hull(rays_near(sightings_of(mask, taken), 1), UP, order=2)
    across = hull.axis.point - CENTER
    assert np.linalg.norm(across[:2]) < 0.001
    assert hull.axis.direction == pytest.approx(UP, abs=0.02)
    found = find_outside(hull, support=-hull.axis.point[2])
    assert found is not None
    assert found.kind == "revolution"
    z = found.outside[:, 1] + hull.axis.point[2]
    side = (z > 0.01) & (z < height - 0.01)
    assert np.abs(found.outside[side, 0] - (low + (high - low) * z[side] / height)).mean() < 0.0012
    assert z.max() == pytest.approx(height, abs=0.003)


def test_the_edge_of_a_thin_foot_stays_sharp() -> None:
    heights = np.arange(-0.001, 0.28, 0.00086)
    profile = (
        np.array([(0, 46), (3.4, 46.5), (10, 20), (16, 7), (30, 5), (110, 5), (150, 54), (200, 55), (277, 44)]) / 1e3
    )
    found = find_outside(upright_hull(heights, np.interp(heights, *profile.T, left=0, right=0)), support=0.0)
    assert found is not None
    at = np.linspace(0.001, 0.009, 17)
    assert np.interp(at, *found.outside.T[::-1]) == pytest.approx(np.interp(at, *profile.T), abs=0.0006)


def test_an_egg_closes_over_its_axis_at_both_ends() -> None:
    radius, half = 0.035, 0.05
    taken = cameras()
    hull = find_hull(rays_near(sightings_of(ellipsoid_mask(taken, radius, half), taken), 1), UP, order=0)
    found = find_solid(hull, support=None)
    assert found is not None
    assert not found.has_flat_top
    assert (found.is_closed, found.kind) == (True, "revolution")
    assert found.height == pytest.approx(2 * half, abs=0.001)
    middle = found.outside[[0, -1], 1].mean()
    height = (found.outside[:, 1] - middle) / half
    side = np.abs(height) < 0.9
    assert np.abs(found.outside[side, 0] - radius * np.sqrt(1 - height[side] ** 2)).mean() < 0.0005


def test_a_solid_that_stands_on_a_table_is_flat_at_both_ends_and_as_wide_as_masks_show() -> None:
    low, high, height = 0.03, 0.045, 0.11
    hull = hull_of_cone(low, high, height)
    found = find_solid(hull, support=-hull.axis.point[2])
    assert found is not None
    assert found.has_flat_top
    assert found.solid is not None
    z = found.solid[:, 1] + hull.axis.point[2]
    assert (z.min(), z.max()) == pytest.approx((0, height), abs=0.001)
    side = (z > 0.002) & (z < height - 0.002)
    assert np.abs(found.solid[side, 0] - (low + (high - low) * z[side] / height)).mean() < 0.0005


def test_a_ray_beyond_a_flat_end_adds_no_thread_to_a_disc() -> None:
    radius, thickness = 0.045, 0.02
    beside, at, slope = np.meshgrid(np.linspace(-0.06, 0.06, 61), np.linspace(-0.07, 0.05, 481), [-0.05, 0.05])
    beside, at, slope = beside.ravel(), at.ravel(), slope.ravel()
    along = np.linspace(-0.06, 0.06, 61)[:, None]
    inside = (np.hypot(along, beside) < radius) & (np.abs(at + slope * along - thickness / 2) < thickness / 2)
    hits = inside.any(axis=0)
    hits[np.argmin(np.hypot(beside, at + 0.05))] = True  # Through the axis, 5 cm below the disc.
    directions = np.stack([np.ones_like(slope), np.zeros_like(slope), slope], axis=1)
    rays = NearRays(
        origins=np.stack([np.zeros_like(at), beside, at], axis=1) - directions,
        directions=directions / np.linalg.norm(directions, axis=1, keepdims=True),
        reach=np.full(len(hits), np.inf),
        hits=hits,
        is_edge=np.ones(len(hits), bool),
        view=np.zeros(len(hits), int),
        pixel_angle=0.001,
    )
    hull = hull_about(rays, Axis(point=np.zeros(3), direction=UP), np.linspace(-0.08, 0.08, 501), order=0)
    found = hull.heights[hull.radii > 0]
    assert (found.min(), found.max()) == pytest.approx((0, thickness), abs=0.003)


def test_a_glass_on_a_table_is_no_wider_below_its_foot() -> None:
    low, high, height, half_table = 0.03, 0.045, 0.11, 0.2
    taken = cameras()
    o, d = all_rays(taken)
    to_table = -o[..., 2] / d[..., 2]
    from_middle = (o + to_table[..., None] * d)[..., :2] - CENTER[:2]
    is_on = (np.abs(from_middle) < half_table).all(axis=-1) & (to_table > 0)
    depth = np.where(is_on, to_table, np.inf).astype(np.float32)
    masked = dataclasses.replace(sightings_of(cone_mask(taken, low, high, height), taken), depth=depth)
    rays = rays_near(masked, 1)
    # A flat ray just above the table, nearer to a height just below it.
    flat = {
        "origins": CENTER - [0.7, -0.01, CENTER[2] - 0.0001],
        "directions": [1.0, 0.0, 0.0],
        "hits": True,
        "is_edge": True,
        "view": 0,
        "reach": np.inf,
    }
    rays = dataclasses.replace(
        rays, **{name: np.append(getattr(rays, name), np.array([value]), axis=0) for name, value in flat.items()}
    )
    heights = np.arange(-0.0802, 0.08, 0.001)
    hull = hull_about(rays, Axis(point=CENTER, direction=UP), heights, order=0)
    assert hull.radii.max() == pytest.approx(high, abs=0.0015)
    assert not hull.radii[heights < -CENTER[2]].any()


def test_the_border_of_a_picture_is_no_edge_of_an_object_that_goes_on_beyond_it() -> None:
    taken, mask = cameras(), np.zeros((VIEWS, SIZE, SIZE), bool)
    mask[:, 20:40, :30] = True
    rays = rays_near(sightings_of(mask, taken), 1)
    # Two rows above and below, and two columns at the right.
    assert (rays.is_edge & rays.hits).sum() == VIEWS * (4 * 30 + 16 * 2)


def test_a_thing_in_front_whose_known_outline_is_too_narrow_cuts_nothing_away() -> None:
    radius, taken = 0.045, cameras()
    _, d = all_rays(taken)
    mask = ball_mask(taken, radius)
    column = np.broadcast_to(np.arange(SIZE), mask.shape)
    hides = (column > SIZE // 2 + 2) & (np.arange(VIEWS) % 2 == 0)[:, None, None]
    narrow = (column > SIZE // 2 + 4) & hides
    depth = np.where(narrow, 0.1, np.inf).astype(np.float32) * np.ones_like(d[..., 0])
    seen = dataclasses.replace(sightings_of(mask & ~hides, taken), depth=depth)

    def radius_of(sightings: Sightings) -> float:
        hull = hull_about(
            rays_near(sightings, 1), Axis(point=CENTER, direction=UP), np.linspace(-0.06, 0.06, 241), order=0
        )
        return float(hull.radii.max())

    assert radius_of(seen) < 0.7 * radius
    assert radius_of(dataclasses.replace(seen, depth=doubted(depth, seen.first))) == pytest.approx(radius, abs=0.002)


def test_a_pane_of_glass_that_is_found_is_a_surface_that_others_stand_on() -> None:
    use_mitsuba()
    radius, top, taken = 0.045, 0.005, cameras()
    o, d = all_rays(taken)
    ball = ball_mask(taken, radius)
    pane = d[..., 2] < 0  # As large as the pictures; cameras are above it.
    first = np.where(ball, 1, np.where(pane, 2, 0)).astype(np.uint8)
    seen = dataclasses.replace(sightings_of(ball | pane, taken), first=first, unknown=(1, 2))
    box = Box(
        center=np.array([0.0, 0.0, top - 0.004]),
        axes=np.eye(3),
        half_sizes=np.array([3.0, 3.0, 0.004]),
        rounding=0.001,
    )
    known = with_known(seen, 2, box.mesh())
    assert known.unknown == (1,) and not (known.first == 2).any()
    down = ((top - o[..., 2]) / d[..., 2])[pane & ~ball]
    depth = known.depth[pane & ~ball]
    assert np.allclose(depth[down < 2], down[down < 2], rtol=1e-4)
    assert not depth[down > 6].any(), "beside the box, rays say nothing"
    assert height_below(known.found, UP, np.array([0.0, 0.0, 0.02]), 0.03) == pytest.approx(top, abs=1e-5)
    assert height_below(known.found, UP, np.array([0.0, 0.0, 0.2]), 0.03) is None
