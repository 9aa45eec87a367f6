"""Tests the keys of scene.json that its page names, cameras that a scene lists, and those of films."""

import dataclasses
import json
import re
import typing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.synthetic import synthetic_scene, write_synthetic_dataset

from datagen.data.cameras import Lens, look_at
from datagen.data.config import DatasetConfig, square
from datagen.data.dataset import Dataset
from datagen.data.transforms import TRANSFORMS_FILES
from datagen.disk.errors import HyalineError
from datagen.scene.description import CameraList
from datagen.scene.folder import _SceneFile, load_scene, save_scene, scene_files
from datagen.scene.rig import _orbit, make_cameras, make_path, with_listed_views

PAGE = Path(__file__).resolve().parents[3] / "docs" / "scene-json.md"


def records_in(kind: object) -> set[type]:
    """The records that a type contains, itself included."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return {kind}.union(*(records_in(hints[field.name]) for field in dataclasses.fields(kind)))
    return set().union(*map(records_in, typing.get_args(kind)))


def test_the_page_of_scene_json_names_every_key_of_every_record_and_no_other() -> None:
    sections = re.findall(r"^## (.*?)$(.*?)(?=^## |\Z)", PAGE.read_text(), flags=re.MULTILINE | re.DOTALL)
    named = {title: set(re.findall(r"^\| `(\w+)`", text, flags=re.MULTILINE)) for title, text in sections}
    expected = {}
    for record in records_in(_SceneFile):
        keys = {field.name for field in dataclasses.fields(record)}
        is_inner = record.__name__.startswith("_")
        title = "The file" if record is _SceneFile else record.__name__.removeprefix("_")
        expected[title] = keys if is_inner else keys | {"type"}
    assert named == expected


def test_cameras_that_are_listed_are_read_as_they_stand(tmp_path: Path) -> None:
    save_scene(synthetic_scene(), tmp_path)
    data = json.loads((tmp_path / "scene.json").read_text())
    rng = np.random.default_rng(0)
    target = np.array([0.1, 0.0, 0.2])
    places = {
        split: rng.normal(size=(count, 3))
        for split, count in (("train", 5), ("interpolating", 2), ("extrapolating", 3))
    }
    for place in places.values():
        place[:, 2] = 1 + np.abs(place[:, 2])
    poses = {split: np.stack([look_at(one, target) for one in place]) for split, place in places.items()}
    del data["cameras"]
    (tmp_path / "scene.json").write_text(json.dumps(data))
    with pytest.raises(HyalineError, match=r"scene.json: has no cameras; expected `cameras` there, or transforms_tr"):
        load_scene(tmp_path)
    listed = {split: [{"transform_matrix": pose.tolist()} for pose in each] for split, each in poses.items()}
    for split, frames in listed.items():
        (tmp_path / TRANSFORMS_FILES[split]).write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    scene = load_scene(tmp_path)
    assert scene.cameras.target == pytest.approx(target, abs=1e-5)
    config = DatasetConfig.even("synthetic", square(16), 8)
    with pytest.raises(HyalineError, match=r"train: 8 views are asked for, and the scene lists 5 cameras"):
        make_cameras(scene.cameras, config)
    made = make_cameras(scene.cameras, with_listed_views(config, scene.cameras))
    for name, cameras in made.items():
        assert np.array_equal(cameras.world_from_camera, poses[name])
        assert cameras.fov_x == 0.6
    assert scene_files(load_scene(tmp_path)) == scene_files(scene)
    listed["train"][1]["transform_matrix"][0][0] += 0.1
    (tmp_path / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": listed["train"]}))
    with pytest.raises(
        HyalineError, match=r"train.json: frames\[1\].transform_matrix: .*expected a rotation and a place"
    ):
        load_scene(tmp_path)


@pytest.mark.parametrize(("first", "last"), [(-30.0, 100.0), (150.0, 260.0), (0.0, 360.0)])
def test_listed_cameras_know_where_on_the_circle_around_their_target_they_stand(first: float, last: float) -> None:
    azimuth = np.radians(np.linspace(first, last, 14))
    elevation = np.radians(np.linspace(10, 50, 14))
    across = 2 * np.cos(elevation)
    places = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), 2 * np.sin(elevation)], axis=1)
    lens = Lens(fov_x=0.6, width=1, height=1)
    train = lens.cameras(np.stack([look_at(place, np.zeros(3)) for place in places]))
    cameras = CameraList(train=train, interpolating=train, extrapolating=train)
    assert cameras.radius == pytest.approx(2, abs=1e-5)
    assert cameras.elevation_deg == pytest.approx((10, 50), abs=1e-3)
    found = np.array(cameras.azimuth_deg)
    assert found[1] - found[0] == pytest.approx(last - first, abs=1e-3)
    assert (found[0] - first + 180) % 360 == pytest.approx(180, abs=1e-3)


# Films


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("path") / "data")


RIG = dataclasses.replace(synthetic_scene().cameras, target=(0.1, 0.2, 0.3), radius=2.0, elevation_deg=(20.0, 40.0))


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


@pytest.mark.parametrize(("path", "center"), [("spline", (2, 6)), ("orbit", None)])
def test_a_principal_point_stays_where_it_is_in_the_picture(
    dataset: Dataset, path: str, center: tuple[int, int] | None
) -> None:
    lens = dataset.cameras("interpolating")
    lens = dataclasses.replace(lens, center=(lens.width / 4, 3 * lens.height / 4))
    aside = SimpleNamespace(objects=dataset.objects, home=dataset, cameras=lambda _: lens)
    assert make_path(aside, path, 3, width=8, height=8).center == center  # type: ignore[arg-type]
