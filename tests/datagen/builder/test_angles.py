"""Tests where the cameras of the splits by angle stand."""

import dataclasses
import math

import numpy as np
import pytest
from support.synthetic import quad, synthetic_scene

from datagen.builder.angles import angle_outside, make_angle_cameras, places_outside
from datagen.data.config import ANGLE_SPLITS, DatasetConfig, square
from datagen.data.meshes import Mesh
from datagen.scene.description import CameraRig

RIG = dataclasses.replace(
    synthetic_scene().cameras, target=(0.2, -0.1, 0.5), radius=2.0, elevation_deg=(8, 60), azimuth_deg=(-150, 40)
)
OPEN = dataclasses.replace(RIG, azimuth_deg=(-30, 30), elevation_deg=(10, 40))


def covered_directions(rig: CameraRig, step_deg: float) -> np.ndarray:
    """Directions to training cameras, densely."""
    elevation = np.radians(np.arange(rig.elevation_deg[0], rig.elevation_deg[1] + 1e-9, step_deg))
    azimuth = np.radians(np.arange(rig.azimuth_deg[0], rig.azimuth_deg[1] + 1e-9, step_deg))
    e, a = (grid.ravel() for grid in np.meshgrid(elevation, azimuth))
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)


def wall(x: float) -> Mesh:
    """A large square across the x axis."""
    flat = quad(0.0)
    vertices = np.stack([np.full(4, x), 4 * flat.vertices[:, 0], 4 * flat.vertices[:, 1]], axis=1).astype(np.float32)
    return dataclasses.replace(flat, vertices=vertices)


@pytest.mark.parametrize("rig", [RIG, OPEN, dataclasses.replace(RIG, azimuth_deg=(0, 360))])
def test_the_angle_outside_is_that_to_the_nearest_covered_direction(rig: CameraRig) -> None:
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    dense = covered_directions(rig, 0.5)
    nearest = np.arccos(np.clip((directions @ dense.T).max(axis=1), -1, 1))
    assert np.degrees(np.abs(angle_outside(rig, directions) - nearest)).max() < 0.4
    inside = dense[:: len(dense) // 50]
    assert np.degrees(angle_outside(rig, inside)).max() < 1e-5


@pytest.mark.parametrize("degrees", ANGLE_SPLITS.values())
def test_places_lie_so_far_outside_at_the_training_distance(degrees: float) -> None:
    for rig in (RIG, OPEN):
        offset = (places_outside(rig, (quad(-3.0),), math.radians(degrees)) - rig.target) / rig.radius
        assert len(offset) > 100
        assert np.linalg.norm(offset, axis=1) == pytest.approx(1)
        found = np.degrees(np.arccos(np.clip((offset @ covered_directions(rig, 0.5).T).max(axis=1), -1, 1)))
        assert np.abs(found - degrees).max() < 0.1
        assert offset[:, 2].min() > math.sin(math.radians(5)) - 1e-6
    # They lie on both sides of the open region, and above it.
    azimuth = np.degrees(np.arctan2(offset[:, 1], offset[:, 0]))
    assert azimuth.min() < -30 < 30 < azimuth.max()
    assert np.degrees(np.arcsin(offset[:, 2].max())) == pytest.approx(40 + degrees, abs=0.3)


def test_no_camera_walks_through_a_wall() -> None:
    free = places_outside(OPEN, (quad(-3.0),), math.radians(40))
    x = OPEN.target[0] + 0.5  # Training is in front of it, 0.8 m and more.
    left = places_outside(OPEN, (quad(-3.0), wall(x)), math.radians(40))
    assert free[:, 0].min() < x - 0.1
    assert 50 < len(left) < len(free)
    assert left[:, 0].min() > x
    # No more than a margin of 3 degrees is lost in front of it.
    assert len(left) > np.count_nonzero(free[:, 0] > x + 0.11)


def test_cameras_aim_at_the_centre_and_are_spread() -> None:
    scene = dataclasses.replace(synthetic_scene(), cameras=RIG)
    cameras = make_angle_cameras(scene, DatasetConfig.even("s", square(24), 5))
    assert list(cameras) == list(ANGLE_SPLITS)
    for item in cameras.values():
        places = item.world_from_camera[:, :3, 3]
        aim = -item.world_from_camera[:, :3, 2]
        assert np.abs(places + RIG.radius * aim - RIG.target).max() < 1e-9
        apart = np.linalg.norm(places[:, None] - places, axis=-1) + 9 * np.eye(5)
        assert apart.min() > 0.2
        assert (item.width, item.fov_x) == (24, math.radians(RIG.fov_deg))
