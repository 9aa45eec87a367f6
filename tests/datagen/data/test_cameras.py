"""Tests where cameras stand and which rays they shoot."""

import dataclasses
import json
import math

import numpy as np
import pytest
from support.rigs import RIG, config
from support.synthetic import pixel_rays, synthetic_scene

from datagen.data.cameras import Cameras, look_at, subpixel_offsets, subpixel_rays
from datagen.data.config import Resolution
from datagen.data.transforms import parse_transforms, transforms_bytes
from datagen.disk.errors import HyalineError
from datagen.scene.rig import make_cameras


def test_training_and_interpolating_cameras_lie_on_the_cropped_hemisphere() -> None:
    cameras = make_cameras(RIG, config())
    for split in ("train", "interpolating"):
        offset = cameras[split].world_from_camera[:, :3, 3] - RIG.target
        assert np.linalg.norm(offset, axis=1) == pytest.approx(RIG.radius)
        elevation = np.degrees(np.arcsin(offset[:, 2] / RIG.radius))
        azimuth = np.degrees(np.arctan2(offset[:, 1], offset[:, 0]))
        assert 5 - 1e-6 <= elevation.min()
        assert elevation.max() <= 70 + 1e-6
        assert -60 - 1e-6 <= azimuth.min()
        assert azimuth.max() <= 150 + 1e-6
    train = cameras["train"].world_from_camera[:, :3, 3]
    assert np.ptp(train, axis=0).min() > 0.8 * RIG.radius  # They cover it, rather than huddle.


def test_the_walk_starts_and_ends_at_its_points_and_leaves_the_hemisphere() -> None:
    walk = make_cameras(RIG, config())["extrapolating"].world_from_camera[:, :3, 3]
    assert walk[0] == pytest.approx(RIG.walk[0].position)
    assert walk[-1] == pytest.approx(RIG.walk[-1].position)
    distance = np.linalg.norm(walk - RIG.target, axis=1) / RIG.radius
    assert distance.min() < 0.8
    assert distance.max() > 1.3


def test_a_camera_is_a_rotation_that_looks_at_its_target() -> None:
    matrix = look_at(np.array([1.0, 2.0, 3.0]), np.array([-1.0, 0.5, 0.0]))
    rotation = matrix[:3, :3]
    assert rotation @ rotation.T == pytest.approx(np.eye(3))
    assert np.linalg.det(rotation) == pytest.approx(1)
    forward = np.array([-2.0, -1.5, -3.0])
    assert -rotation[:, 2] == pytest.approx(forward / np.linalg.norm(forward))
    assert rotation[2, 0] == pytest.approx(0)  # Level: the camera's right has no height.
    with pytest.raises(HyalineError, match="looks straight up or down"):
        look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    with pytest.raises(HyalineError, match="expected finite numbers"):
        look_at((0.0, 0.0, np.nan), (0.0, 0.0, 1.0))


def test_rays_equal_the_ones_of_a_second_implementation() -> None:
    cameras = make_cameras(synthetic_scene().cameras, config(views=3))["train"]
    origin, directions = cameras[2].rays()
    expected_origin, expected = pixel_rays(cameras, 2)
    assert origin == pytest.approx(expected_origin)
    assert np.abs(directions - expected).max() < 1e-6


def test_lens_and_depths_survive_the_transforms_files_of_any_size() -> None:
    pose = look_at(np.array([3.0, 1.0, 2.0]), np.zeros(3))[None]
    once = Cameras(world_from_camera=pose, fov_x=0.8, width=24, height=16, center=(9.25, 10.0), near=0.5, far=7.25)
    data = transforms_bytes(once, "train")
    keys = json.loads(data)
    focal = 12 / math.tan(0.4)
    assert [keys[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")] == [focal, focal, 9.25, 10.0, 24, 16]
    assert (keys["near"], keys["far"]) == (0.5, 7.25)
    again = parse_transforms(data, where="file")
    for name in ("fov_x", "width", "height", "center", "near", "far"):
        assert getattr(again, name) == getattr(once, name)
    plain = dataclasses.replace(once, center=None, near=None, far=None)
    written = transforms_bytes(plain, "train")
    assert "near" not in json.loads(written) and parse_transforms(written, where="file").center is None
    twice = once.fitted(Resolution(width=48, height=32))
    assert (twice.width, twice.height, twice.center, twice.near) == (48, 32, (18.5, 20.0), 0.5)
    finer = twice[0].rays()[1].reshape(16, 2, 24, 2, 3).mean(axis=(1, 3))
    assert np.abs(finer - once[0].rays()[1]).max() < 1e-3


@pytest.mark.parametrize("center", [None, (1.0, 3.5)])
def test_subpixel_rays_are_the_pixel_centre_rays_of_a_finer_picture(center: tuple[float, float] | None) -> None:
    poses = np.stack([look_at(np.array([3.0, 1.0, 2.0]), np.zeros(3)), look_at(np.array([0.5, -2.0, 1.0]), np.ones(3))])
    coarse = Cameras(world_from_camera=poses, fov_x=0.8, width=5, height=4, center=center)
    fine = coarse.fitted(Resolution(width=15, height=12))
    offsets = np.broadcast_to(subpixel_offsets(9), (2 * 20, 9, 2))
    origins, directions = subpixel_rays(coarse, np.arange(2 * 20), offsets)
    for view in range(2):
        origin, expected = fine[view].rays()
        here = directions.reshape(2, 4, 5, 3, 3, 3)[view]  # Row, column, row and column in the pixel, xyz.
        assert np.abs(here.transpose(0, 2, 1, 3, 4).reshape(12, 15, 3) - expected).max() < 1e-6
        assert (origins.reshape(2, -1, 3)[view] == origin).all()
    with pytest.raises(HyalineError, match="rays: is 5; expected a square number of rays per pixel"):
        subpixel_offsets(5)
