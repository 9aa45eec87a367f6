"""Tests that cameras of COLMAP, of NeRF tools and of glTF stand where they stood, and that broken ones are refused."""

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from support.gltf import BOX, GltfBuilder
from support.theirs import write_binary_model
from support.traced_dataset import write_traced_dataset

from datagen.data.cameras import look_at
from datagen.data.config import SPLITS
from datagen.data.dataset import open_dataset
from datagen.data.ply import write_ply
from datagen.data.transforms import lens_keys
from datagen.disk.errors import HyalineError
from datagen.scene.camera_list import CameraList
from datagen.scene.description import Scene, SoftEnvironment
from datagen.scene.import_choices import ImportChoices
from datagen.scene.remarks import Remarks
from datagen.scene.staging import subject_box
from hyaline_export.formats import export_dataset
from hyaline_import.cameras import colmap_images, read_camera_file
from hyaline_import.importing import import_scene
from hyaline_import.lights import IRRADIANCE


@pytest.fixture(scope="module")
def colmap(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, float]:
    """A folder of COLMAP's, and the cameras and the angle that it holds."""
    root = tmp_path_factory.mktemp("colmap")
    write_traced_dataset(root / "ours", resolution=16)
    dataset = open_dataset(root / "ours")
    export_dataset(dataset, "colmap", root / "theirs", num_points=20, flow=False)
    write_binary_model(root / "theirs/sparse/0")
    splits = ("extrapolating", "interpolating", "train")  # As the names of the pictures are sorted.
    poses = np.concatenate([dataset.cameras(split).world_from_camera for split in splits])
    return root / "theirs", poses, dataset.cameras("train").fov_x


@pytest.mark.parametrize("left_out", ["bin", "txt"])
def test_colmaps_cameras_are_read_from_text_and_from_binary_files(
    colmap: tuple[Path, np.ndarray, float], tmp_path: Path, left_out: str
) -> None:
    theirs, poses, fov_x = colmap
    ending = {"bin": "txt", "txt": "bin"}[left_out]
    for name in ("cameras", "images"):
        source = next(theirs.rglob(f"{name}.{ending}"))
        (tmp_path / source.name).write_bytes(source.read_bytes())
    remarks = Remarks()
    found = read_camera_file(tmp_path, remarks)
    assert np.abs(np.stack([camera.world_from_camera for camera in found]) - poses).max() < 1e-6
    assert found[0].fov_x == pytest.approx(fov_x, rel=1e-9) and remarks.lines == []


def test_a_reconstruction_is_found_where_captures_keep_it(colmap: tuple[Path, np.ndarray, float]) -> None:
    theirs, poses, _ = colmap
    assert len(read_camera_file(theirs, Remarks())) == len(poses)


CAMERA = "1 PINHOLE 100 80 120 120 50 40\n"
IMAGE = "1 1 0 0 0 0 0 5 1 a.png\n\n"


def write_text(root: Path, cameras: str, images: str) -> Path:
    (root / "cameras.txt").write_text(cameras)
    (root / "images.txt").write_text(images)
    return root


@pytest.mark.parametrize(
    ("cameras", "images", "message"),
    [
        ("1 OPENCV_FISHEYE 9 9 1 1 1 1 0 0 0 0\n", IMAGE, "of model 'OPENCV_FISHEYE'; expected one of SIMPLE_PINHOLE"),
        ("1 PINHOLE 100 80 120\n", IMAGE, "1 numbers of a PINHOLE"),
        ("1 PINHOLE 100 80 0 0 50 40\n", IMAGE, "a focal length of 0"),
        ("1 PINHOLE 100 80 nan nan 50 40\n", IMAGE, "a focal length of nan"),
        (CAMERA, "1 0 0 0 0 0 0 5 1 a.png\n\n", "a rotation of length 0"),
        (CAMERA, "1 1 0 0 0 0 0 5 7 a.png\n\n", "was taken by camera 7; expected one that cameras.txt has"),
        (CAMERA, "1 1 0 0\n\n", "has a line that cannot be read"),
        (CAMERA, "", "has 0 images; expected 1 to 10,000"),
        (CAMERA, "# a comment\n", "has 0 images"),
    ],
)
def test_broken_text_of_colmap_is_refused(tmp_path: Path, cameras: str, images: str, message: str) -> None:
    with pytest.raises(HyalineError, match=message):
        read_camera_file(write_text(tmp_path, cameras, images), Remarks())


@pytest.mark.parametrize("points", ["\n", "", "10.5 20.25 -1 11.0 21.0 7\n"])
def test_text_of_colmap_may_lack_the_empty_lines_of_images_without_points(tmp_path: Path, points: str) -> None:
    images = "".join(f"{k} 1 0 0 0 {k} 0 5 1 picture {k}.png\n{points}" for k in range(1, 5))
    assert len(read_camera_file(write_text(tmp_path, CAMERA, f"# a comment\n{images}"), Remarks())) == 4


def test_names_of_pictures_may_have_spaces(tmp_path: Path) -> None:
    images = "".join(f"{k} 1 0 0 0 0 0 5 1 shot  {k} of 2.png\n1.5 2.5 -1\n" for k in (1, 2))
    assert [*colmap_images(write_text(tmp_path, CAMERA, images))] == ["shot  1 of 2.png", "shot  2 of 2.png"]


def test_distorted_lenses_are_drawn_straight_and_said_to_be(tmp_path: Path) -> None:
    remarks = Remarks()
    (camera,) = read_camera_file(write_text(tmp_path, "1 OPENCV 100 80 120 121 44 41 0.1 0 0 0\n", IMAGE), remarks)
    assert [line.what for line in remarks.lines] == [
        "have a distorted lens; drawn as pinholes",
        "have pixels that are not square; drawn square, as wide as they are",
    ]
    assert (camera.focal, camera.center) == (pytest.approx(120), (44, 41))
    assert (camera.width, camera.height) == (100, 80)


@pytest.mark.parametrize(("model", "is_said"), [("EQUIRECTANGULAR", True), ("FISHEYE624", True), ("opencv", False)])
def test_panoramas_and_fisheyes_are_said_to_be_drawn_as_pinholes(tmp_path: Path, model: str, is_said: bool) -> None:
    frame = {"transform_matrix": np.eye(4).tolist(), "camera_model": model}
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 50, "w": 64, "h": 48, "frames": [frame]}))
    remarks = Remarks()
    read_camera_file(tmp_path / "transforms.json", remarks)
    assert [line.what for line in remarks.lines] == ["have a distorted lens; drawn as pinholes"] * is_said


def test_the_lens_of_a_transforms_file_keeps_its_principal_point_and_shape(tmp_path: Path) -> None:
    (tmp_path / "box.ply").write_bytes(write_ply(BOX))
    frames = [{"transform_matrix": look_at((2.0, place, 1.5), (0.0, 0.0, 0.0)).tolist()} for place in range(4)]
    lens = {"fl_x": 50, "fl_y": 50, "cx": 30, "cy": 14, "w": 64, "h": 48}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    choices = ImportChoices(cameras=str(tmp_path / "transforms.json"), material=("glass",), up="z")
    cameras = import_scene(tmp_path / "box.ply", choices).scene.cameras
    assert isinstance(cameras, CameraList)
    assert {key: lens_keys(cameras.train)[key] for key in lens} == pytest.approx(lens)
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "cx": 1e6, "frames": frames}))
    with pytest.raises(HyalineError, match=r"frames.0.: camera: its principal point is 1e\+06, 14"):
        import_scene(tmp_path / "box.ply", choices)


def test_a_binary_file_cut_anywhere_is_refused(colmap: tuple[Path, np.ndarray, float], tmp_path: Path) -> None:
    theirs, _, _ = colmap
    whole = {name: next(theirs.rglob(f"{name}.bin")).read_bytes() for name in ("cameras", "images")}
    for name, data in whole.items():
        for length in (0, 3, 8, 20, 60, len(data) - 1):
            for other, content in whole.items():
                (tmp_path / f"{other}.bin").write_bytes(content[:length] if other == name else content)
            with pytest.raises(HyalineError, match=r"cut off|no images|has 0 images"):
                read_camera_file(tmp_path, Remarks())


@pytest.mark.parametrize("count", [1 << 63, 10_001])
def test_counts_that_no_file_can_hold_are_refused(
    colmap: tuple[Path, np.ndarray, float], tmp_path: Path, count: int
) -> None:
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", count))
    (tmp_path / "cameras.bin").write_bytes(next(colmap[0].rglob("cameras.bin")).read_bytes())
    with pytest.raises(HyalineError, match="entries; expected at most 10,000"):
        read_camera_file(tmp_path, Remarks())


def test_cameras_beside_a_model_move_with_it(tmp_path: Path) -> None:
    (tmp_path / "box.ply").write_bytes(write_ply(BOX))
    frames = []
    for place in range(10):
        angle = 2 * math.pi * place / 10
        back = np.array([math.cos(angle), 0.0, math.sin(angle)])  # Around +y, which is up in PLY files.
        matrix = np.eye(4)
        matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = (0, 1, 0), back, 3 * back
        matrix[:3, 0] = np.cross(matrix[:3, 1], back)
        frames.append({"file_path": f"{place}.png", "transform_matrix": matrix.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    choices = ImportChoices(cameras=str(tmp_path / "transforms.json"), material=("glass",), scale=0.5)
    scene = import_scene(tmp_path / "box.ply", choices).scene
    assert isinstance(scene.cameras, CameraList) and scene.cameras.train.fov_x == pytest.approx(0.6)
    poses = np.concatenate([scene.cameras.of(split).world_from_camera for split in SPLITS])
    assert len(poses) == 10
    box = next(item.mesh.vertices for item in scene.objects if item.name != "ground")
    middle = (box.min(axis=0) + box.max(axis=0)) / 2
    # All of them look at the box's middle, level, from 1.5 m away.
    np.testing.assert_allclose(poses[:, :3, 3] - 1.5 * poses[:, :3, 2], np.tile(middle, (10, 1)), atol=1e-5)
    np.testing.assert_allclose(poses[:, :3, 1], np.tile([0, 0, 1], (10, 1)), atol=1e-9)


@pytest.mark.parametrize(
    ("given", "message"),
    [("nowhere", "--cameras .*nowhere: is not a file"), (".", "holds no cameras; expected transforms.json")],
)
def test_a_place_without_cameras_is_refused(tmp_path: Path, given: str, message: str) -> None:
    with pytest.raises(HyalineError, match=message):
        read_camera_file(tmp_path / given, Remarks())


# glTF


WIDE = {"type": "perspective", "perspective": {"yfov": 0.5, "aspectRatio": 2.0}}


def with_camera(tmp_path: Path, camera: dict = WIDE, **node: object) -> Path:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh())
    builder.content["cameras"] = [camera]
    builder.node(camera=0, translation=[0, 0.2, 3], **node)
    return builder.written(tmp_path)


def test_gltfs_own_cameras_are_taken_when_asked_for(tmp_path: Path) -> None:
    path = with_camera(tmp_path, scale=[2, 2, 2])
    around = import_scene(path, ImportChoices())
    assert any("the file brings 1, which --cameras file takes" in line for line in around.told())
    scene = import_scene(path, ImportChoices(cameras="file")).scene
    assert isinstance(scene.cameras, CameraList)
    lens = scene.cameras.train
    assert (lens.width, lens.height) == (2000, 1000)
    assert lens.fov_x == pytest.approx(2 * math.atan(2 * math.tan(0.25)))
    pose = lens.world_from_camera[0]
    # glTF's +z is our -y, and the scene's box stands on the ground.
    height = float(BOX.vertices[:, 1].max())
    np.testing.assert_allclose(pose[:3, 3], (0, -3, 0.2 + height), atol=1e-5)
    np.testing.assert_allclose(pose[:3, 2], (0, -1, 0), atol=1e-9)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"type": "perspective", "perspective": {"yfov": 0.0}}, "sees 0 radians"),
        ({"type": "perspective", "perspective": {"yfov": "wide"}}, "yfov: is 'wide'; expected a number"),
        ({"type": "perspective", "perspective": {"yfov": 1.0, "aspectRatio": -1}}, "an aspect of -1"),
        ({"type": "orthographic"}, "--cameras file: the file brings no cameras"),
    ],
)
def test_broken_cameras_of_gltf_are_refused(tmp_path: Path, camera: dict, message: str) -> None:
    path = with_camera(tmp_path, camera)
    with pytest.raises(HyalineError, match=message):
        import_scene(path, ImportChoices(cameras="file"))


@pytest.mark.parametrize("index", [1, -1, "a"])
def test_a_camera_that_is_not_there_is_refused(tmp_path: Path, index: object) -> None:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh())
    builder.node(camera=index)
    with pytest.raises(HyalineError, match=r"cameras\[1\]; the file has 0|expected an integer from 0"):
        import_scene(builder.written(tmp_path), ImportChoices())


def with_lamps(tmp_path: Path, *lamps: dict, **node: object) -> Path:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh())
    builder.content["extensions"] = {"KHR_lights_punctual": {"lights": list(lamps)}}
    for index in range(len(lamps)):
        builder.node(extensions={"KHR_lights_punctual": {"light": index}}, **node)
    return builder.written(tmp_path)


UP = [2**-0.5, 0, 0, -(2**-0.5)]
"""Turns a lamp that shines along -z so that it shines along -y: downwards."""


def irradiance(scene: Scene, at: np.ndarray) -> np.ndarray:
    """What squares give at a place, on what faces each of them."""
    total = np.zeros(3)
    for light in scene.lights:
        corner, u, v = (np.array(part) for part in (light.corner, light.edge_u, light.edge_v))
        middle, normal = corner + (u + v) / 2, np.cross(u, v)
        way = at - middle
        total += np.array(light.radiance) * float(normal @ way) / np.linalg.norm(way) ** 3
    return total


def test_lamps_of_gltf_shine_on_the_scene_when_asked_for(tmp_path: Path) -> None:
    lamps = (
        {"type": "point", "color": [1, 0.5, 0.25], "intensity": 90},
        {"type": "spot", "intensity": 90, "spot": {"outerConeAngle": 0.5}},
    )
    path = with_lamps(tmp_path, *lamps, translation=[0, 3, 0], rotation=UP)
    soft = import_scene(path, ImportChoices())
    assert soft.scene.lights == () and any("2 are left out for soft light" in line for line in soft.told())
    scene = import_scene(path, ImportChoices(lights="file")).scene
    assert len(scene.lights) == 2
    found = irradiance(scene, subject_box(scene.objects[:1]).mean(axis=0))
    assert found.mean() == pytest.approx(IRRADIANCE, rel=0.01)
    np.testing.assert_allclose(found / found[0], (1, 1.5 / 2, 1.25 / 2), rtol=1e-6)
    assert all(light.corner[2] == pytest.approx(3 + BOX.vertices[:, 1].max(), abs=0.01) for light in scene.lights)


def test_a_directional_lamp_is_a_sun(tmp_path: Path) -> None:
    path = with_lamps(tmp_path, {"type": "directional", "intensity": 7.0}, rotation=UP)
    sky = import_scene(path, ImportChoices(lights="file")).scene.environment
    assert isinstance(sky, SoftEnvironment)
    (sun,) = sky.lobes
    np.testing.assert_allclose(sun.direction, (0, 0, 1), atol=1e-9)
    cosines = np.linspace(0, 1, 200_001)
    flux = 2 * np.pi * np.trapezoid(sun.radiance[0] * np.exp(sun.sharpness * (cosines - 1)) * cosines, cosines)
    assert flux == pytest.approx(IRRADIANCE, rel=0.01)


@pytest.mark.parametrize(
    ("lamp", "message"),
    [
        ({"type": "tube"}, "type: is 'tube'; expected one of directional, point, spot"),
        ({"type": "point", "intensity": -1}, "an intensity of -1"),
        ({"type": "spot", "spot": {"outerConeAngle": 0}}, "a cone of 0"),
        ({"type": "spot", "intensity": 9}, "brings no lamp that shines on the scene"),
        ({"type": "point", "intensity": 0}, "brings no lamp that shines on the scene"),
    ],
)
def test_broken_lamps_are_refused(tmp_path: Path, lamp: dict, message: str) -> None:
    path = with_lamps(tmp_path, lamp, translation=[0, -3, 0], rotation=UP)
    with pytest.raises(HyalineError, match=message):
        import_scene(path, ImportChoices(lights="file"))


def test_a_file_without_lamps_has_none_to_take(tmp_path: Path) -> None:
    with pytest.raises(HyalineError, match="--lights file: the file brings no lamp"):
        import_scene(with_lamps(tmp_path), ImportChoices(lights="file"))
