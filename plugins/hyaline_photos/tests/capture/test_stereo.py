"""Tests that depth maps and the surfaces fused from them are those of a scene whose shape is known by formula."""

import dataclasses
import math

import numpy as np
import pytest
from jaxtyping import Float, Float32, UInt8

from datagen.data.cameras import Cameras, Lens, look_at
from datagen.data.images import linear_from_srgb, srgb_from_linear, to_8bit
from datagen.scene.atlas import faces_apart
from datagen.scene.mending import atlas_fault
from datagen.scene.rig import towards
from hyaline_photos.capture.exposure import find_exposures
from hyaline_photos.capture.room import Outline, fit_room, lacking
from hyaline_photos.capture.stereo import DepthMaps, find_depths, fuse

RADIUS, FLOOR = 0.25, -0.25
"""A ball around the origin, on a floor."""
SIDE, VIEWS = 64, 16
BORDERS = (0.7, 3.0)
"""Least and largest depth."""


def around(side: int = SIDE) -> Cameras:
    aways = [1.2 * np.array(towards(360 * view / VIEWS, 30 + 15 * (view % 2))) for view in range(VIEWS)]
    places = [look_at(away, (0.0, 0.0, 0.0)) for away in aways]
    return Lens(fov_x=0.8, width=side, height=side).cameras(np.stack(places))


def seen(cameras: Cameras, view: int) -> tuple[Float32[np.ndarray, "h w"], Float[np.ndarray, "h w 3"], np.ndarray]:
    """Depth along the axis, the place on the surface, and whether it is the ball's."""
    origin, directions = (part.astype(np.float64) for part in cameras[view].rays())
    along = -directions @ origin
    root = along**2 - origin @ origin + RADIUS**2
    at_ball = np.where(root > 0, along - np.sqrt(np.maximum(root, 0)), np.inf)
    at_floor = np.where(directions[..., 2] < 0, (FLOOR - origin[2]) / directions[..., 2], np.inf)
    t = np.minimum(at_ball, at_floor)
    axis = -cameras.world_from_camera[view][:3, 2]
    return (t * (directions @ axis)).astype(np.float32), origin + t[..., None] * directions, at_ball < at_floor


def painted(place: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Waves of many directions, on the surface."""
    rng = np.random.default_rng(0)
    waves = sum(np.sin(place @ rng.normal(size=3, scale=40) + rng.uniform(0, 6)) for _ in range(12))
    return np.repeat(np.clip(128 + 25 * waves, 0, 255)[..., None], 3, axis=-1).astype(np.uint8)


@pytest.fixture(scope="module")
def maps() -> DepthMaps:
    cameras = around()
    places = [seen(cameras, view)[1] for view in range(VIEWS)]
    nothing = [np.zeros((SIDE, SIDE), bool)] * VIEWS
    return find_depths([painted(place) for place in places], nothing, cameras, np.zeros(3), BORDERS)


def test_depths_are_those_of_ball_and_floor(maps: DepthMaps) -> None:
    for view in range(VIEWS):
        expected, _, is_ball = seen(maps.cameras, view)
        found = maps.depth[view]
        error = np.abs(found - expected)[found > 0] / expected[found > 0]
        assert np.median(error) < 0.01
        assert (found > 0)[is_ball].mean() > 0.5


def test_larger_pictures_find_finer_depths_of_the_same_surfaces(maps: DepthMaps) -> None:
    large = around(4 * SIDE)
    places = [seen(large, view)[1] for view in range(VIEWS)]
    nothing = [np.zeros((4 * SIDE, 4 * SIDE), bool)] * VIEWS
    found = find_depths([painted(place) for place in places], nothing, large, np.zeros(3), BORDERS)

    def miss(some: DepthMaps, view: int) -> float:
        expected, _, _ = seen(some.cameras, view)
        shown = some.depth[view] > 0
        return float(np.median(np.abs(some.depth[view] - expected)[shown] / expected[shown]))

    assert np.mean([miss(found, view) / miss(maps, view) for view in range(VIEWS)]) < 0.7
    assert np.mean([(found.depth[view] > 0)[seen(large, view)[2]].mean() for view in range(VIEWS)]) > 0.6
    points = found.points(1e-6)
    points = points[np.linalg.norm(points, axis=1) < 1]
    on_ball, on_floor = np.abs(np.linalg.norm(points, axis=1) - RADIUS), np.abs(points[:, 2] - FLOOR)
    assert np.mean(np.minimum(on_ball, on_floor) < 0.01) > 0.9


def test_neither_glass_nor_plain_surfaces_get_depths(maps: DepthMaps) -> None:
    cameras = around()
    places = [seen(cameras, view)[1] for view in range(VIEWS)]
    is_glass = [seen(cameras, view)[2] for view in range(VIEWS)]
    pictures = [painted(place) for place in places]
    for picture, place in zip(pictures, places, strict=True):
        picture[place[..., 0] > 0.5] = 200
    found = find_depths(pictures, is_glass, cameras, np.zeros(3), BORDERS)
    assert not found.depth[np.stack(is_glass)].any()
    plain = np.stack([place[..., 0] > 0.62 for place in places])  # Half a window away from what is painted.
    assert plain.sum() > 500
    assert (found.depth[plain] > 0).mean() < 0.02
    rest = np.stack([place[..., 0] < 0.38 for place in places]) & ~np.stack(is_glass)
    assert (found.depth > 0)[rest].sum() > 0.4 * (maps.depth > 0)[rest].sum()


def test_the_fused_surface_is_the_balls(maps: DepthMaps) -> None:
    low, high = np.full(3, -0.35), np.full(3, 0.35)
    (ball,) = fuse(maps, low, high, 0.015, lambda place: place[:, 2] > FLOOR + 0.05)
    distance = np.linalg.norm(ball.vertices, axis=1)
    assert np.abs(distance - RADIUS).mean() < 0.006
    assert np.abs(distance - RADIUS).max() < 0.04
    corners = ball.vertices[ball.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * corners.mean(axis=1)).sum(axis=1) > 0).mean() > 0.99, "outward"
    assert np.linalg.norm(normals, axis=1).sum() / 2 > 0.4 * 4 * math.pi * RADIUS**2


def test_each_face_can_have_a_chart_of_its_own(maps: DepthMaps) -> None:
    (ball,) = fuse(maps, np.full(3, -0.35), np.full(3, 0.35), 0.03, lambda place: place[:, 2] > FLOOR + 0.05)
    apart = faces_apart(ball)
    assert atlas_fault(ball) is not None and atlas_fault(apart) is None
    assert np.array_equal(apart.vertices[apart.faces], ball.vertices[ball.faces])


def test_nothing_is_fused_where_no_view_saw_anything() -> None:
    cameras = around()
    empty = DepthMaps(cameras=cameras, depth=np.zeros((VIEWS, SIDE, SIDE), np.float32))
    assert fuse(empty, np.full(3, -0.3), np.full(3, 0.3), 0.02, lambda place: place[:, 2] > -1) == []


def test_a_thing_is_its_surface_where_depth_maps_show_it(maps: DepthMaps) -> None:
    rng = np.random.default_rng(0)
    away = rng.normal(size=(600, 3))
    ball = RADIUS * away / np.linalg.norm(away, axis=1, keepdims=True)
    floor = np.concatenate([rng.uniform(-1, 1, (900, 2)), np.full((900, 1), FLOOR)], axis=1)
    glass = [Outline(name="glass", center=(-0.6, 0.0, FLOOR + 0.05), radii=(0.05, 0.05, 0.05))]
    places = maps.cameras.world_from_camera[:, :3, 3]
    room = fit_room(np.concatenate([ball, floor]), glass, places, maps)
    assert np.abs(np.linalg.norm(room.parts["thing_0"].vertices, axis=1) - RADIUS).mean() < 0.006
    assert np.mean(lacking(room.parts, maps)) < 0.05
    assert np.mean(lacking({"floor": room.parts["floor"]}, maps)) > 0.1
    assert not any(name.startswith("thing") for name in fit_room(np.concatenate([ball, floor]), glass, places).parts)


@pytest.mark.parametrize("spread", [0.2, 0.0])
def test_exposures_are_found_from_points_that_pictures_share(maps: DepthMaps, spread: float) -> None:
    rng = np.random.default_rng(1)
    gains = spread * rng.standard_normal((VIEWS, 1)) + 0.2 * spread * rng.standard_normal((VIEWS, 3))
    rows, columns = np.indices((SIDE, SIDE)) + 0.5 - SIDE / 2
    falloff = -spread * (rows**2 + columns**2) / (SIDE**2 / 2)
    pictures = []
    for view, gain in enumerate(gains):
        place = seen(maps.cameras, view)[1]
        linear = 0.05 + 0.5 * linear_from_srgb(painted(place) / 255.0)
        pictures.append(to_8bit(srgb_from_linear(linear * np.exp(gain + falloff[..., None]))))
    # The last two stand for test pictures, of which no depths are known.
    some = dataclasses.replace(maps.cameras, world_from_camera=maps.cameras.world_from_camera[:-2])
    known = DepthMaps(cameras=some, depth=maps.depth[:-2])
    found = find_exposures(pictures, maps.cameras, known, known.points(0.01))
    assert found.gains == pytest.approx(gains - gains[:-2].mean(axis=0), abs=0.04)
    assert found.falloff == pytest.approx(-spread, abs=0.03)
    if not spread:
        assert np.array_equal(found.corrected(pictures[0], 0), pictures[0])
