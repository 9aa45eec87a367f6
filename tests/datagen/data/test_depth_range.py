"""Tests near and far against points strewn over surfaces, and against distances that are known."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh
from support.meshes import mesh_of
from support.synthetic import quad

from datagen.data.cameras import NO_SURFACE, Cameras, look_at, with_depth_range
from datagen.data.meshes import Mesh, no_mesh

ABOVE = look_at((0.0, 1e-3, 2.0), (0.0, 0.0, 0.0))[None]


def triangles(corners: np.ndarray) -> Mesh:
    return mesh_of(trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False))


def depth_range(cameras: Cameras, *meshes: Mesh) -> tuple[float, float]:
    made = with_depth_range({"train": cameras}, meshes)["train"]
    assert made.near is not None and made.far is not None
    return made.near, made.far


@pytest.mark.parametrize("seed", range(3))
def test_they_hold_every_surface_of_a_picture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Some triangles are larger than a picture, some cross its border, some the plane of the camera.
    corners = rng.normal(size=(30, 3, 3)) * rng.choice([0.1, 1, 3], size=(30, 1, 1)) + rng.normal(size=(30, 1, 3))
    mesh = triangles(corners.reshape(-1, 3))
    poses = np.stack([look_at(2 * rng.normal(size=3), rng.normal(size=3)) for _ in range(3)])
    cameras = Cameras(world_from_camera=poses, fov_x=0.7, width=24, height=16, center=(9.0, 20.0))
    near, far = depth_range(cameras, mesh)
    share = np.sort(rng.random((100_000, 2)), axis=1)
    weight = np.stack([share[:, 0], share[:, 1] - share[:, 0], 1 - share[:, 1]], axis=1)
    points = np.einsum("pc,pcx->px", weight, corners.astype(np.float32)[rng.integers(30, size=len(weight))])
    for camera in (cameras[view] for view in range(3)):
        pixels, depth = camera.project(points)
        inside = (depth > 0) & ((pixels >= 0) & (pixels <= (24, 16))).all(axis=1)
        distance = np.linalg.norm(points - camera.world_from_camera[:3, 3], axis=1)[inside]
        assert near < distance.min() and distance.max() < far


def test_a_plane_ahead_is_nearest_where_it_is_perpendicular_and_farthest_in_a_corner() -> None:
    cameras = Cameras(world_from_camera=ABOVE, fov_x=2 * math.atan(0.4), width=40, height=20)
    near, far = depth_range(cameras, quad(0.5))
    assert near == pytest.approx(0.99 * 1.5, rel=1e-3)
    assert far == pytest.approx(1.01 * math.sqrt(1.5**2 + 2), rel=1e-3)


def test_all_splits_have_the_same_and_what_no_picture_shows_does_not_count() -> None:
    down = Cameras(world_from_camera=ABOVE, fov_x=0.5, width=8, height=8)
    up = dataclasses.replace(down, world_from_camera=ABOVE @ np.diag([1.0, -1.0, -1.0, 1.0]))
    made = with_depth_range({"train": down, "interpolating": up}, (quad(0.5), quad(9.0), no_mesh()))
    assert {(item.near, item.far) for item in made.values()} == {(made["train"].near, made["train"].far)}
    assert made["train"].near == pytest.approx(0.99 * 1.5, rel=1e-3)
    assert made["train"].far is not None and made["train"].far > 7  # The plane overhead, which test views show.
    assert depth_range(up, quad(0.5)) == NO_SURFACE
    assert depth_range(down) == depth_range(down, no_mesh()) == NO_SURFACE


def test_a_surface_through_the_camera_still_leaves_a_near_above_zero() -> None:
    cameras = Cameras(world_from_camera=ABOVE, fov_x=0.5, width=8, height=8)
    wall = triangles(np.array([[0.0, 1e-3, 2.0], [1, 0, 0], [-1, 0, 0]]))
    near, far = depth_range(cameras, wall)
    assert 0 < near < 1e-3 and 1 < far < 3
