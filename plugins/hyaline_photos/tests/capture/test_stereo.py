"""Tests that depth maps and the surfaces fused from them are those of a scene whose shape is known by formula."""

import math

import numpy as np
import pytest
from jaxtyping import Float, Float32, UInt8

from datagen.data.cameras import Cameras, Lens, look_at
from datagen.scene.rig import towards
from hyaline_photos.capture.room import Outline, fit_room
from hyaline_photos.capture.stereo import DepthMaps, find_depths, fuse

RADIUS, FLOOR = 0.25, -0.25
"""A ball around the origin, on a floor."""
SIDE, VIEWS = 64, 16


def around() -> Cameras:
    aways = [1.2 * np.array(towards(360 * view / VIEWS, 30 + 15 * (view % 2))) for view in range(VIEWS)]
    places = [look_at(away, (0.0, 0.0, 0.0)) for away in aways]
    return Lens(fov_x=0.8, width=SIDE, height=SIDE).cameras(np.stack(places))


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
    some = np.concatenate([place.reshape(-1, 3)[::37] for place in places])
    return find_depths([painted(place) for place in places], nothing, cameras, some)


def test_depths_are_those_of_ball_and_floor(maps: DepthMaps) -> None:
    for view in range(VIEWS):
        expected, _, is_ball = seen(maps.cameras, view)
        found = maps.depth[view]
        error = np.abs(found - expected)[found > 0] / expected[found > 0]
        assert np.median(error) < 0.01
        assert (found > 0)[is_ball].mean() > 0.5


def test_neither_glass_nor_plain_surfaces_get_depths(maps: DepthMaps) -> None:
    cameras = around()
    places = [seen(cameras, view)[1] for view in range(VIEWS)]
    is_glass = [seen(cameras, view)[2] for view in range(VIEWS)]
    pictures = [painted(place) for place in places]
    for picture, place in zip(pictures, places, strict=True):
        picture[place[..., 0] > 0.5] = 200
    found = find_depths(
        pictures, is_glass, cameras, np.concatenate([place[::9, ::9].reshape(-1, 3) for place in places])
    )
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


def test_nothing_is_fused_where_no_view_saw_anything() -> None:
    cameras = around()
    empty = DepthMaps(cameras=cameras, depth=np.zeros((VIEWS, SIDE, SIDE), np.float32))
    assert fuse(empty, np.full(3, -0.3), np.full(3, 0.3), 0.02, lambda place: place[:, 2] > -1) == []


def test_a_thing_is_its_surface_where_depth_maps_show_it_and_a_box_elsewhere(maps: DepthMaps) -> None:
    rng = np.random.default_rng(0)
    away = rng.normal(size=(600, 3))
    ball = RADIUS * away / np.linalg.norm(away, axis=1, keepdims=True)
    floor = np.concatenate([rng.uniform(-1, 1, (900, 2)), np.full((900, 1), FLOOR)], axis=1)
    unseen = np.array((0.6, 0.6, FLOOR)) + rng.uniform(0, 0.15, (200, 3))
    glass = [Outline(name="glass", center=(-0.6, 0.0, FLOOR + 0.05), radii=(0.05, 0.05, 0.05))]
    places = maps.cameras.world_from_camera[:, :3, 3]
    points = np.concatenate([ball, floor, unseen])
    with_maps = {name: mesh.vertices for name, mesh in fit_room(points, glass, places, maps).parts.items()}
    assert {"thing_0", "box_0"} <= with_maps.keys()
    assert np.abs(np.linalg.norm(with_maps["thing_0"], axis=1) - RADIUS).mean() < 0.006
    assert np.abs(with_maps["box_0"].mean(axis=0)[:2] - 0.675).max() < 0.03
    assert "box_1" not in with_maps
    without = fit_room(points, glass, places).parts.keys()
    assert {"box_0", "box_1"} <= without and "thing_0" not in without
