"""Tests of camera paths: closed turns, and curves that pass their keys."""

import dataclasses

import numpy as np
import pytest
from support.synthetic import write_synthetic_dataset

from datagen.data.cameras import Cameras
from datagen.data.dataset import Dataset
from datagen.scene.description import CameraRig, WalkPoint
from datagen.scene.rig import _orbit, make_path


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("path") / "data")


RIG = CameraRig(
    target=(0.1, 0.2, 0.3),
    radius=2.0,
    elevation_deg=(20.0, 40.0),
    walk=(WalkPoint(position=(2, 0, 1), target=(0, 0, 0)), WalkPoint(position=(0, 2, 1), target=(0, 0, 0))),
)


@pytest.mark.parametrize("azimuth", [(0.0, 360.0), (-60.0, 60.0)])
def test_an_orbit_keeps_its_distance_and_its_bounds_and_closes(azimuth: tuple[float, float]) -> None:
    rig = dataclasses.replace(RIG, azimuth_deg=azimuth)
    poses = _orbit(rig, 36)
    offset = poses[:, :3, 3] - np.array(rig.target)
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), rig.radius)
    np.testing.assert_allclose(offset[:, 2], rig.radius * np.sin(np.radians(30)))
    looks = -poses[:, :3, 2]
    np.testing.assert_allclose(looks, -offset / rig.radius, atol=1e-12)
    angle = np.degrees(np.arctan2(offset[:, 1], offset[:, 0]))
    if azimuth == (-60.0, 60.0):
        assert -60 < angle.min() < -50 and 50 < angle.max() < 60
    else:
        np.testing.assert_allclose(np.diff(np.unwrap(np.radians(angle))), np.radians(10))
    steps = np.linalg.norm(np.diff(offset, axis=0, append=offset[:1]), axis=1)
    assert steps[-1] <= steps.max() + 1e-9, "the last frame is one step before the first"


def test_a_spline_passes_through_every_test_view(dataset: Dataset) -> None:
    keys = dataset.cameras("interpolating")
    cameras = make_path(dataset, "spline", 9, width=None, height=None)
    assert (cameras.width, cameras.height, cameras.fov_x) == (keys.width, keys.height, keys.fov_x)
    np.testing.assert_allclose(cameras.world_from_camera[[0, 8]], keys.world_from_camera, atol=1e-9)
    rotations = cameras.world_from_camera[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (9, 1, 1)), atol=1e-12)


class Aside:
    """A dataset whose lens has its principal point aside."""

    def __init__(self, dataset: Dataset, lens: Cameras) -> None:
        self.objects, self.home, self._lens = dataset.objects, dataset, lens

    def cameras(self, split: str) -> Cameras:
        return self._lens


@pytest.mark.parametrize(("path", "center"), [("spline", (2, 6)), ("orbit", None)])
def test_a_principal_point_stays_where_it_is_in_the_picture(
    dataset: Dataset, path: str, center: tuple[int, int] | None
) -> None:
    lens = dataset.cameras("interpolating")
    aside = Aside(dataset, dataclasses.replace(lens, center=(lens.width / 4, 3 * lens.height / 4)))
    assert make_path(aside, path, 3, width=8, height=8).center == center  # type: ignore[arg-type]
