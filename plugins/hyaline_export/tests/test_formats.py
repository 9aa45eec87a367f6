"""Tests that each export shows the dataset's world: vertices, pictures, depth, masks and points, by its own reader."""

import dataclasses
import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
import scipy.spatial
import trimesh
from support.commands import run
from support.export_readers import (
    ReadView,
    bop_visibility,
    read_blender,
    read_bop,
    read_colmap_text,
    read_nerfstudio,
    read_picture,
    read_ply_points,
)
from support.traced_dataset import BALL, write_traced_dataset

from datagen.data.dataset import Dataset, View
from datagen.data.meshes import no_mesh
from datagen.disk.errors import HyalineError
from datagen.quantities import quantities, surfaces_of
from datagen.scene.modelling import lathe
from datagen.terminal.plugins import VERSION
from hyaline_export.bop import symmetries
from hyaline_export.formats import FORMATS, export_dataset
from hyaline_export.sensor import BASELINE, MAX_STRETCH, sensor_depth
from hyaline_export.source import Source

POINTS = 600


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_traced_dataset(tmp_path_factory.mktemp("source") / "glasses")


@pytest.fixture(scope="module")
def exports(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Every format, exported once."""
    root = tmp_path_factory.mktemp("exports")
    for form in FORMATS.built_in:
        export_dataset(dataset, form, root / form, num_points=POINTS)
    return {form: root / form for form in FORMATS.built_in}


def view_of(dataset: Dataset, name: str) -> View:
    split, _, index = name.rpartition("_")
    return dataset.view(split, int(index))  # type: ignore[arg-type]


def check_vertices(dataset: Dataset, views: dict[str, ReadView]) -> None:
    """Vertices of the cube and the ball fall where the dataset's rays go."""
    assert views
    meshes = {item.name: item.mesh for item in surfaces_of(dataset).scene.objects}
    for name, read in views.items():
        view = view_of(dataset, name)
        camera = view.camera
        vertices = np.concatenate([meshes["cube"].vertices, meshes["ball"].vertices]).astype(np.float64)
        pixels = read.project(vertices)
        _, directions = camera.rays()
        # Beside the ray through its pixel's centre, a vertex lies by less than half a pixel's width.
        inside = ((pixels >= 0) & (pixels < camera.width)).all(axis=-1)
        column, row = np.floor(pixels[inside]).astype(int).T
        towards = vertices[inside] - camera.world_from_camera[:3, 3]
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        off = (pixels[inside] - np.stack([column, row], axis=-1) - 0.5) / camera.intrinsics[0, 0]
        right, up, back = camera.world_from_camera[:3, :3].T
        ray = directions[row, column] / -(directions[row, column] @ back)[:, None]
        expected = ray + off[:, :1] * right - off[:, 1:] * up
        expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
        assert np.abs(expected - towards).max() * camera.intrinsics[0, 0] < 0.01


def check_picture(dataset: Dataset, name: str, file: Path, channels: int) -> None:
    picture = read_picture(file)
    assert picture.shape[-1] == channels
    assert np.array_equal(picture[..., :3], view_of(dataset, name).image)
    assert channels == 3 or (picture[..., 3] == 255).all()


def test_nerfstudio_reads_views_splits_depth_and_points(dataset: Dataset, exports: dict[str, Path]) -> None:
    root = exports["nerfstudio"]
    views, splits = read_nerfstudio(root)
    check_vertices(dataset, views)
    assert {name: len(listed) for name, listed in splits.items()} == {"train": 8, "val": 2, "test": 4}
    assert sorted(name for listed in splits.values() for name in listed) == sorted(views)
    for name, read in views.items():
        check_picture(dataset, name, read.file, channels=3)
        found = quantities(view_of(dataset, name))
        depth = read_picture(root / read.frame["depth_file_path"]).astype(np.float64) / 1000
        assert np.abs(depth - found.depth_along_axis).max() <= 0.0005 + 1e-6
        assert np.array_equal(read_picture(root / read.frame["mask_file_path"]) == 255, found.glass)
        # nerfstudio would leave what this key masks out of training.
        assert "mask_path" not in read.frame


@pytest.mark.parametrize("form", ["blender", "3dgs"])
def test_blender_reads_every_split(form: str, dataset: Dataset, exports: dict[str, Path]) -> None:
    root = exports[form]
    splits = {split: read_blender(root, split) for split in ("train", "val", "test")}
    assert [len(views) for views in splits.values()] == [8, 2, 4]
    for views in splits.values():
        for name, read in views.items():
            check_picture(dataset, name, read.file, channels=4)
    check_vertices(dataset, splits["train"])
    check_vertices(dataset, splits["test"])


def test_colmap_reads_cameras_and_points(dataset: Dataset, exports: dict[str, Path]) -> None:
    root = exports["colmap"]
    views, points = read_colmap_text(root)
    check_vertices(dataset, views)
    assert len(views) == 14 and points.shape == (POINTS, 6)
    for name, read_view in views.items():
        check_picture(dataset, name, read_view.file, channels=3)
    lists = {name: (root / f"{name}_list.txt").read_text().split() for name in ("train", "val", "test")}
    assert {name: len(listed) for name, listed in lists.items()} == {"train": 8, "val": 2, "test": 4}
    # Each picture is in one list: nerfstudio refuses a split whose list is missing while another's is there.
    assert sorted(name for listed in lists.values() for name in listed) == sorted(f"{name}.png" for name in views)


@pytest.mark.parametrize("role", ["train", "val", "test"])
def test_bop_says_of_every_object_what_the_toolkit_finds(role: str, dataset: Dataset, exports: dict[str, Path]) -> None:
    root = exports["bop"]
    views = read_bop(scene := root / f"{role}_pbr/000000")
    assert len(views) == {"train": 8, "val": 2, "test": 4}[role]
    check_vertices(dataset, views)
    num_truncated = 0
    for name, read in views.items():
        check_picture(dataset, name, read.file, channels=3)
        found = quantities(view_of(dataset, name))
        depth = read_picture(scene / f"depth/{read.frame['number']:06d}.png") / 1000
        assert np.abs(depth - found.depth_along_axis).max() <= 0.0005 + 1e-6
        for index, (gt, info) in enumerate(zip(read.frame["gt"], read.frame["info"], strict=True)):
            masks = (scene / f"{kind}/{read.frame['number']:06d}_{index:06d}.png" for kind in ("mask", "mask_visib"))
            mask, visible = (read_picture(file) == 255 for file in masks)
            assert np.array_equal(visible, found.object_id == gt["obj_id"]) and not (visible & ~mask).any()
            its_mask, its_visible, expected = bop_visibility(root, scene, read.frame, index)
            assert (mask != its_mask).sum() <= 1 and (visible != its_visible).sum() <= 1
            # Far beyond the picture, its rays along the edge that the floor's triangles share miss both.
            within = {"px_count_all": 0.01 * info["px_count_all"], "visib_fract": 0.002}
            for key, value in expected.items():
                assert np.abs(np.subtract(info[key], value)).max() <= within.get(key, 2), key
            num_truncated += info["px_count_all"] > mask.sum()
    assert num_truncated > 0


def test_bop_models_are_in_millimetres_with_their_diameters_and_symmetries(
    dataset: Dataset, exports: dict[str, Path]
) -> None:
    infos = json.loads((exports["bop"] / "models/models_info.json").read_text())
    assert [info["name"] for info in infos.values()] == [item.name for item in dataset.objects]
    for number, info in infos.items():
        model = trimesh.load_mesh(exports["bop"] / f"models/obj_{int(number):06d}.ply")
        assert np.abs(model.bounds[0] - [info[f"min_{axis}"] for axis in "xyz"]).max() < 1e-3
        assert np.abs(model.extents - [info[f"size_{axis}"] for axis in "xyz"]).max() < 1e-3
        assert np.abs(model.bounds.sum(axis=0)).max() < 1e-3
        assert info["diameter"] == pytest.approx(scipy.spatial.distance.pdist(np.unique(model.vertices, axis=0)).max())
    found = {info["name"]: {key: value for key, value in info.items() if "sym" in key} for info in infos.values()}
    assert [sym["axis"] for sym in found["ball"]["symmetries_continuous"]] == np.eye(3).tolist()
    assert len(found["pane"]["symmetries_discrete"]) == 1 and not found["floor"] and not found["cube"]
    turns = np.reshape(found["slab"]["symmetries_discrete"], (3, 4, 4))
    quarter, half, three_quarters = [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]
    assert np.abs(turns[:, :2, :2] - [quarter, half, three_quarters]).max() < 1e-9


@pytest.mark.parametrize(("sides", "key"), [(84, "continuous"), (7, "discrete"), (1, None)])
def test_a_solid_of_revolution_is_symmetric_around_its_axis(sides: int, key: str | None) -> None:
    points = lathe([(0.0, 0.0), (0.03, 0.0), (0.04, 0.1), (0.0, 0.1)], segments=84).vertices.astype(float)
    if key != "continuous":  # Dents at as many of its sides.
        turn = np.arctan2(points[:, 1], points[:, 0])
        points[:, :2] *= 1 - 0.1 * (np.cos(sides * turn) > 0.999)[:, None]
    found = symmetries(points, points[:1], 0.13)
    assert [*found] == ([] if key is None else [f"symmetries_{key}"])


def test_a_sensor_sees_through_a_slab_not_into_a_ball_nor_where_the_projector_is_hidden(
    dataset: Dataset, exports: dict[str, Path]
) -> None:
    scene = exports["bop-sensor"] / "train_pbr/000000"
    cube = trimesh.Trimesh(surfaces_of(dataset).meshes[4].vertices, surfaces_of(dataset).meshes[4].faces)
    num_hidden = num_through = 0
    for name, read in read_bop(scene).items():
        found = quantities(view_of(dataset, name))
        camera, depth = found.view.camera, sensor_depth(found)
        stored = read_picture(scene / f"depth/{read.frame['number']:06d}.png") / 1000
        assert np.abs(stored - depth).max() <= 0.0005 + 1e-6 and not depth[found.background].any()
        # Ids count objects that an edit has removed, too.
        here = surfaces_of(dataset)
        there = dataclasses.replace(here.scene, objects=(here.scene.objects[0], *here.scene.objects))
        found.__dict__["surfaces"] = dataclasses.replace(here, scene=there, meshes=(no_mesh(), *here.meshes))
        assert np.array_equal(sensor_depth(found), depth)
        del found.__dict__["surfaces"]
        true = np.where(found.glass, found.light_ends.depth_along_axis, found.depth_along_axis)
        steps, exact = (8 * camera.focal * BASELINE / values[depth > 0] for values in (depth, true))
        assert np.abs(steps - np.rint(steps)).max() < 0.01 and np.abs(steps - exact).max() < 0.51
        on_floor = found.object_mask("floor")
        towards = camera.world_from_camera[:3] @ [BASELINE, 0, 0, 1] - found.position[on_floor]
        is_hidden = cube.ray.intersects_any(found.position[on_floor] + 1e-3 * towards, towards)
        assert ((depth[on_floor] == 0) == is_hidden).mean() > 0.995
        # A ball turns what is behind it upside down.
        assert not depth[found.object_mask("ball") & (found.opaque_object_id == 1)].any()
        for axis in (0, 1):
            jumps = (np.abs(np.diff(found.light_ends.flow, axis=axis)) > MAX_STRETCH).any(axis=-1)
            for side in (slice(None, -1), slice(1, None)):
                there = (slice(None),) * axis + (side,)
                assert not depth[there][jumps & found.glass[there]].any()
        through = found.object_mask("slab") & (depth > 0) & (found.light_ends.object_id == 1)
        num_hidden, num_through = num_hidden + is_hidden.sum(), num_through + through.sum()
    assert num_hidden > 5 and num_through > 300


def test_points_lie_on_surfaces_in_their_colours(dataset: Dataset, exports: dict[str, Path]) -> None:
    for form, file in (("nerfstudio", "sparse_pc.ply"), ("3dgs", "points3d.ply")):
        position, normal, color = read_ply_points(exports[form] / file)
        assert len(position) == POINTS and np.abs(np.linalg.norm(normal, axis=-1) - 1).max() < 1e-5
        on_floor = np.abs(position[:, 2]) < 1e-4
        center, radius = BALL
        distance = np.linalg.norm(position - center, axis=-1)
        on_ball = np.abs(distance - radius) < 0.01
        assert on_floor.sum() > POINTS / 4 and on_ball.any()
        assert np.abs(normal[on_floor] - [0, 0, 1]).max() < 1e-5
        outward = (position[on_ball] - center) / distance[on_ball][:, None]
        assert (normal[on_ball] * outward).sum(axis=-1).min() > 0.99
        # The pictures of this dataset have one colour an object.
        view = dataset.view("train", 0)
        floor_color = view.image[quantities(view).object_mask("floor")][0]
        assert (color[on_floor] == floor_color).all()


def test_views_held_out_are_those_that_training_holds_out(dataset: Dataset) -> None:
    held_out = importlib.import_module("model.run.train").choose_held_out(10, 4)
    source = Source(dataset=dataset, num_points=1)
    assert [item.view.index for item in source.of_role("val")] == held_out


@pytest.mark.parametrize(
    ("form", "out", "points", "message"),
    [
        ("nerfstudo", "out", 1, "no format 'nerfstudo'; did you mean 'nerfstudio'"),
        ("colmap", "glasses/colmap", 1, "lies in the dataset "),
        ("colmap", "out", 0, "points: is 0; expected 1 to"),
    ],
)
def test_what_cannot_be_exported_is_said(form: str, out: str, points: int, message: str, dataset: Dataset) -> None:
    place = dataset.root.parent / out
    with pytest.raises(HyalineError, match=message):
        export_dataset(dataset, form, place, num_points=points)
    assert not place.exists()


def test_hugging_face_finds_every_split_with_its_cameras(dataset: Dataset, tmp_path: Path) -> None:
    run(f"datagen export {dataset.root} --format huggingface --out {tmp_path}")
    _, head, text = (tmp_path / "README.md").read_text().split("---\n", 2)
    listed = re.findall(r"- split: (\w+)\n    path: (\w+)/\*\*\n", head)
    names = []
    for split, folder in listed:
        rows = [json.loads(line) for line in (tmp_path / folder / "metadata.jsonl").read_text().splitlines()]
        pictures = {path.relative_to(tmp_path / folder).as_posix() for path in (tmp_path / folder).rglob("*.png")}
        assert {row[key] for row in rows for key in row if key.endswith("file_name")} == pictures
        for row in rows:
            view = view_of(dataset, row["name"])
            found = quantities(view)
            assert split in (view.split, {"train": "validation"}.get(view.split))
            assert np.array_equal(read_picture(tmp_path / folder / row["file_name"]), view.image)
            depth = read_picture(tmp_path / folder / row["depth_file_name"]) / 1000
            assert np.abs(depth - found.depth_along_axis).max() <= 0.0005 + 1e-6
            assert np.array_equal(read_picture(tmp_path / folder / row["glass_file_name"]) == 255, found.glass)
            assert np.array_equal(row["transform_matrix"], view.camera.world_from_camera)
        names += [row["name"] for row in rows]
    assert [split for split, _ in listed] == ["train", "validation", "interpolating", "extrapolating"]
    assert len(names) == len(set(names)) == 14
    # What `imagefolder` goes by when it is not given the card.
    assert all(re.search(r"(?<![a-z])(train|validation|test)(?![a-z])", folder) for _, folder in listed)
    assert "| `interpolating` | 2 |" in text and "OpenGL" in text
    assert f"exported by hyaline {VERSION} from the dataset `{dataset.seal}`" in text
