"""Tests that a folder of pictures and masks becomes a dataset, and that what is wrong with it is named."""

import json
import math
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from support.commands import call
from support.traced_dataset import write_traced_dataset

from datagen.builder.verify import verify_dataset
from datagen.data.cameras import Cameras, Lens, look_at
from datagen.data.config import SPLITS
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import read_meshes
from datagen.data.images import mask_pixels
from datagen.data.meshes import is_there, signed_volume
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.scene.folder import open_scene
from datagen.scene.rig import towards
from hyaline_photos.capture.folder import (
    EVERY,
    Masks,
    _matched,
    _place_others,
    find_masks,
    find_pictures,
    read_capture,
    read_mask,
)
from hyaline_photos.capture.lenses import TakenLens, redrawn, redrawn_mask, shared_lens
from hyaline_photos.capture.planes import find_up
from hyaline_photos.capture.room import Outline, fit_room
from hyaline_photos.commands import CaptureChoices
from hyaline_photos.fit.fit import refuse_losing
from hyaline_photos.fit.found import FoundGlass, write_geometry
from hyaline_photos.fit.shapes import OUTSIDE, Axis, Revolution, evenly

SIDE = 48
FOV = 0.6
BALLS = {"ball": ((0.0, 0.0, 0.10), 0.10), "wine glass (1)": ((0.22, 0.05, 0.08), 0.08)}
"""Centre and radius of the objects of glass, by the names of their masks' folders."""


def circle(count: int = 18, distance: float = 1.0) -> Cameras:
    """Cameras around the balls, at two heights."""
    places = []
    for view in range(count):
        away = distance * np.array(towards(360 * view / count, 25 + 25 * (view % 2)))
        places.append(look_at(np.array((0.08, 0.02, 0.08)) + away, (0.08, 0.02, 0.08)))
    return Lens(fov_x=FOV, width=SIDE, height=SIDE).cameras(np.stack(places))


def balls_seen(cameras: Cameras, view: int) -> np.ndarray:
    """1 + the place of the ball that each pixel's ray meets first, 0 elsewhere."""
    origin, directions = cameras[view].rays()
    nearest, ids = np.full(directions.shape[:2], np.inf), np.zeros(directions.shape[:2], np.uint8)
    for index, (center, radius) in enumerate(BALLS.values(), start=1):
        to_center = np.array(center) - origin
        along = directions @ to_center
        root = along**2 - to_center @ to_center + radius**2
        distance = np.where(root > 0, along - np.sqrt(np.maximum(root, 0)), np.inf)
        ids[distance < nearest] = index
        nearest = np.minimum(nearest, distance)
    return ids


def write_folder(root: Path, *, cameras: str = "transforms") -> Cameras:
    """A capture of the balls, with a name for each picture that no shell likes."""
    made = circle()
    rng = np.random.default_rng(0)
    frames = []
    (root / "images").mkdir(parents=True)
    for view in range(len(made)):
        name = f"DSC 00{view:02d} é.png"
        ids = balls_seen(made, view)
        Image.fromarray(rng.integers(0, 256, (SIDE, SIDE, 3), np.uint8)).save(root / "images" / name)
        for index, folder in enumerate(BALLS, start=1):
            path = root / "masks" / folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.where(ids == index, 255, 0).astype(np.uint8)).save(path)
        frames.append({"file_path": f"images/{name}", "transform_matrix": made[view].world_from_camera.tolist()})
    if cameras == "transforms":
        (root / "transforms.json").write_text(json.dumps({"camera_angle_x": FOV, "frames": frames}))
    return made


def write_colmap(root: Path, cameras: Cameras, points: np.ndarray, *, turned: np.ndarray, scale: float) -> None:
    """A model as COLMAP writes it as text, in a world of its own axes and unit."""
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    focal = cameras.focal
    (folder / "cameras.txt").write_text(f"# cameras\n1 SIMPLE_PINHOLE {SIDE} {SIDE} {focal} {SIDE / 2} {SIDE / 2}\n")
    lines = []
    for view, path in enumerate(sorted((root / "images").iterdir())):
        pose = cameras.world_from_camera[view]
        rotation = ((turned @ pose[:3, :3]) * [1, -1, -1]).T
        quaternion = " ".join(map(str, Rotation.from_matrix(rotation).as_quat(scalar_first=True)))
        moved = -rotation @ (scale * turned @ pose[:3, 3])
        lines += [f"{view + 1} {quaternion} {moved[0]} {moved[1]} {moved[2]} 1 {path.name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{i} {p[0]} {p[1]} {p[2]} 0 0 0 0.5 1 1" for i, p in enumerate(scale * points @ turned.T)]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("captures") / "two balls"
    write_folder(root)
    return root


@pytest.fixture
def own(folder: Path, tmp_path: Path) -> Path:
    return shutil.copytree(folder, tmp_path / "own")


@pytest.fixture(scope="module")
def captured(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("datasets") / "balls"
    answer = call(f"datagen capture '{folder}' --out {root}")
    assert answer.status == 0, answer.error
    assert f"next: datagen peel {root} && model fit {root}" in answer.err
    return open_dataset(root)


# Masks


MASKS = ("1", "L", "I;16", "LA", "RGB", "red", "palette", "cut out", "on nothing", "0 or 1", "0 or 255 of 16 bits")


@pytest.mark.parametrize("kind", MASKS)
def test_masks_of_all_kinds_show_the_same(kind: str) -> None:
    shown = np.random.default_rng(0).random((9, 7)) < 0.5
    grey = np.where(shown, 255, 0).astype(np.uint8)
    zero, full = np.zeros_like(grey), np.full_like(grey, 255)
    pictures = {
        "I;16": Image.fromarray(np.where(shown, 0xFFFF, 1000).astype(np.uint16)),
        "0 or 255 of 16 bits": Image.fromarray(grey.astype(np.uint16)),
        "red": Image.fromarray(np.stack([grey, zero, zero], axis=-1)),
        "palette": Image.fromarray(shown.astype(np.uint8)).convert("P"),
        "cut out": Image.fromarray(np.stack([zero, zero, zero, grey], axis=-1)),
        "on nothing": Image.fromarray(np.stack([full, grey], axis=-1)),
        "0 or 1": Image.fromarray(shown.astype(np.uint8)),
    }
    pictures["palette"].putpalette([0, 0, 0, 128, 0, 0])
    assert np.array_equal(mask_pixels(pictures.get(kind) or Image.fromarray(grey).convert(kind)), shown)


def test_masks_are_found_whatever_their_ending(tmp_path: Path) -> None:
    names = ("a.png", "b.JPG", "c.webp", "d.jpg", "e.jpg.png", "f.JPEG.PNG")
    pictures = [tmp_path / "images" / f"{letter}.{ending}" for letter, ending in zip("abcdef", ["jpg"] * 5 + ["JPEG"])]
    folder = tmp_path / "masks" / "ball"
    (tmp_path / "masks" / ".x").mkdir(parents=True)
    folder.mkdir()
    for name in (*names, "._a.png"):
        (folder / name).touch()
    objects, masks, remarks = find_masks(tmp_path, pictures)
    assert objects == ("ball",) and [masks[path][0].name for path in pictures] == list(names) and remarks == []


def test_specks_and_pinholes_of_a_mask_are_left_out(tmp_path: Path) -> None:
    ball = np.hypot(*(np.indices((80, 90)) - 40)) < 30
    ball[38:44, 20:60] = False  # Something opaque in front of it.
    spoilt = ball.copy()
    spoilt[40, 80:84], spoilt[25, 30:34] = True, False
    noise = np.random.default_rng(0).normal(0, 15, ball.shape)  # As JPEG leaves it.
    Image.fromarray(np.clip(np.where(spoilt, 225, 30) + noise, 0, 255).astype(np.uint8)).save(tmp_path / "mask.png")
    assert np.array_equal(read_mask(tmp_path / "mask.png", (90, 80)), ball)


# The dataset


def test_each_object_has_a_mask_by_its_id_in_the_dataset(captured: Dataset, folder: Path) -> None:
    ids = {"ball": captured.object_id("ball"), "wine glass (1)": captured.object_id("wine_glass__1_")}
    made, seen = circle(), set()
    for split in SPLITS:
        for view in captured.views(split):
            place = int(np.abs(made.world_from_camera - view.camera.world_from_camera).sum(axis=(1, 2)).argmin())
            assert np.allclose(made.world_from_camera[place], view.camera.world_from_camera)
            expected = np.array([0, *ids.values()], np.uint8)[balls_seen(made, place)]
            found = view.imported_object_ids
            assert found is not None and np.array_equal(found, expected)
            assert np.array_equal(view.mask("glass"), expected > 0)
            picture = np.asarray(Image.open(folder / "images" / f"DSC 00{place:02d} é.png"))
            assert np.array_equal(view.image, picture)
            seen.add((split, place))
    assert {place for split, place in seen if split != "train"} == {0, 8, 16}
    assert len(seen) == len(made) and captured.num_views == {"train": 15, "interpolating": 2, "extrapolating": 1}


def test_a_stand_in_is_where_the_masks_of_an_object_meet(captured: Dataset) -> None:
    meshes = {item.name: item.mesh for item in open_scene(captured).objects}
    pixel = 1.0 * FOV / SIDE
    for name, (center, radius) in zip(("ball", "wine_glass__1_"), BALLS.values(), strict=True):
        low, high = meshes[name].vertices.min(axis=0), meshes[name].vertices.max(axis=0)
        assert np.abs((low + high) / 2 - center).max() < pixel
        assert np.abs((high - low) / 2 - radius).max() < 2 * pixel
        assert signed_volume(meshes[name]) > 0
    # The last two are kept free for drinks.
    glass = [item.name for item in captured.objects if item.is_glass]
    assert glass == ["ball", "wine_glass__1_", "ball_drink", "wine_glass__1__drink"]
    assert not any(is_there(meshes[name]) for name in glass[2:])


def test_a_fit_replaces_its_own_drink_but_no_other_glass(captured: Dataset, tmp_path: Path) -> None:
    copy = open_dataset(Path(shutil.copytree(captured.root, tmp_path / "copy")))
    ball, drink = copy.object_id("ball"), copy.object_id("ball_drink")
    corners = np.array([(0, 0), (0.1, 0), (0.1, 0.2)])
    up = np.array([0.0, 0.0, 1.0])
    solid = Revolution(axis=Axis(point=np.zeros(3), direction=up), outside=evenly(corners, OUTSIDE))
    full = solid.hollowed(0.1, 0.1, 0.3)
    full = full.having(level=0.1)
    found = {ball: FoundGlass(glass=full, unexplained=0.0, drink_id=drink)}
    write_geometry(copy, "fitted", read_meshes(copy, TRUTH), {}, found)
    refuse_losing(copy, "fitted", (ball,))
    with pytest.raises(HyalineError, match="holds a fit of ball, ball_drink, too"):
        refuse_losing(copy, "fitted", (copy.object_id("wine_glass__1_"),))


def test_it_is_whole_and_can_be_peeled(captured: Dataset) -> None:
    assert verify_dataset(captured.root).problems == []
    assert call(f"datagen peel {captured.root}").status == 0
    layers = captured.view("train", 0).layers()
    view = captured.view("train", 0)
    assert view.imported_mask is not None and np.array_equal(view.mask("glass"), view.imported_mask)
    assert not np.array_equal(view.mask("glass"), np.isin(layers.object_id[0], (1, 2)))  # Those are of ellipsoids.
    assert set(np.unique(layers.object_id)) >= {0, captured.object_id("ball"), captured.object_id("floor")}


def test_an_exported_dataset_comes_back_without_its_shapes(tmp_path: Path) -> None:
    write_traced_dataset(tmp_path / "glasses", resolution=16)
    ours = open_dataset(tmp_path / "glasses")
    answer = call(f"datagen export {ours.root} --format capture --out {tmp_path / 'folder'}")
    assert answer.status == 0, answer.error
    assert not list((tmp_path / "folder").rglob("*.ply"))
    answer = call(f"datagen capture {tmp_path / 'folder'} --out {tmp_path / 'again'}")
    assert answer.status == 0, answer.error
    again = open_dataset(tmp_path / "again")
    assert again.num_views == ours.num_views and again.license == ours.license
    glass = {item.name for item in ours.objects if item.is_glass}
    assert {item.name for item in again.objects if item.is_glass} == {*glass, *(f"{name}_drink" for name in glass)}
    for split in SPLITS:
        for old, new in zip(ours.views(split), again.views(split), strict=True):
            assert np.array_equal(old.image, new.image) and new.imported_object_ids is not None
            first = old.object_ids()[0]
            for name in glass:
                assert np.array_equal(new.imported_object_ids == again.object_id(name), first == ours.object_id(name))


def test_test_pictures_and_their_masks_decide_nothing(captured: Dataset, own: Path, tmp_path: Path) -> None:
    for place in (0, 8, 16):
        for path in sorted(own.rglob(f"*00{place:02d}*.png")):
            Image.fromarray(255 - np.asarray(Image.open(path))).save(path)
    answer = call(f"datagen capture {own} --out {tmp_path / 'again'}")
    assert answer.status == 0, answer.error
    again = open_dataset(tmp_path / "again")
    for old, new in zip(open_scene(captured).objects, open_scene(again).objects, strict=True):
        assert old.name == new.name and np.array_equal(old.mesh.vertices, new.mesh.vertices)
    assert not np.array_equal(again.view("extrapolating", 0).image, captured.view("extrapolating", 0).image)


def test_a_picture_without_a_mask_is_left_out(own: Path, tmp_path: Path) -> None:
    (own / THIRD).unlink()
    answer = call(f"datagen capture {own} --out {tmp_path / 'out'}")
    assert answer.status == 0 and "masks: 1 of 18 pictures have none and were left out (DSC 0003" in answer.err
    assert open_dataset(tmp_path / "out").num_views["train"] == 14


@pytest.mark.parametrize("given", ["ball=0.082m", "ball=82mm", "ball=8.2cm"])
def test_a_diameter_has_a_unit(given: str) -> None:
    assert CaptureChoices(diameter=given).known_diameter() == ("ball", pytest.approx(0.082))
    assert CaptureChoices(diameter=given[5:]).known_diameter() == (None, pytest.approx(0.082))


# COLMAP's world


def room_points(rng: np.random.Generator) -> np.ndarray:
    """Points on a floor 0.7 m below a table, on the table, on two walls, on a box, and nowhere."""

    def on(low: tuple[float, float, float], high: tuple[float, float, float], count: int) -> np.ndarray:
        return rng.uniform(low, high, (count, 3))

    return np.concatenate(
        [
            on((-2, -2, -0.7), (2, 2, -0.7), 400),
            on((-0.5, -0.4, 0), (0.5, 0.4, 0), 600),
            on((-2, 2, -0.6), (2, 2, 1.2), 300),
            on((-2, -2, -0.6), (-2, 2, 1.2), 300),
            on((-0.35, 0.2, 0.12), (-0.20, 0.3, 0.12), 10),
            on((-0.35, 0.2, 0.005), (-0.20, 0.2, 0.12), 60),
            on((-0.35, 0.2, 0.005), (-0.35, 0.3, 0.12), 60),
            on((-1, -1, -1), (1, 1, 1), 60),
        ]
    ) + rng.normal(0, 0.001, (1790, 3))


@pytest.fixture(scope="module")
def rotation() -> np.ndarray:
    axes = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    return axes * np.sign(np.linalg.det(axes))


def test_a_model_of_colmap_is_turned_upright_scaled_by_a_diameter_and_given_a_room(
    tmp_path: Path, rotation: np.ndarray
) -> None:
    made = write_folder(tmp_path / "shots", cameras="none")
    every = room_points(np.random.default_rng(1))
    points = np.concatenate([every[:1000], every[1600:1730]])  # A floor, a table, and a box: few voxels.
    write_colmap(tmp_path / "shots", made, points, turned=rotation, scale=3.7)
    answer = call(f"datagen capture {tmp_path / 'shots'} --diameter ball=0.2m --out {tmp_path / 'out'}")
    assert answer.status == 0, answer.error
    dataset = open_dataset(tmp_path / "out")
    meshes = {item.name: item.mesh.vertices for item in open_scene(dataset).objects}
    assert meshes["floor"][:, 2].mean() == pytest.approx(-0.7, abs=0.05)
    assert meshes["table"][:, 2].max() == pytest.approx(0, abs=0.02)
    assert np.sort(np.ptp(meshes["table"], axis=0)[:2]).min() > 0.7
    poses = np.concatenate([dataset.cameras(split).world_from_camera for split in SPLITS])
    heights = np.sort(poses[:, 2, 3])
    assert np.allclose(heights, np.sort(made.world_from_camera[:, 2, 3]), atol=0.06)
    assert any("were fitted to" in line for line in (dataset.imported.remarks if dataset.imported else ()))
    listed = tmp_path / "shots" / "sparse" / "0" / "points3D.txt"
    listed.write_text("\n".join(listed.read_text().splitlines()[:9]) + "\n")  # Too few for depth maps and a room.
    shutil.rmtree(tmp_path / "shots" / "masks" / "wine glass (1)")
    answer = call(f"datagen capture {tmp_path / 'shots'} --out {tmp_path / 'guessed'}")
    assert answer.status == 0, answer.error
    assert "scale: is unknown, so all lengths are relative; the cameras were put 1 m away" in answer.err
    assert "thousandths of the cameras' distance by its masks" in answer.err


def test_planes_are_fitted_in_spite_of_points_that_are_nowhere() -> None:
    points = room_points(np.random.default_rng(0))
    glass = [Outline(name="ball", center=(0.0, 0.0, 0.1), radii=(0.1, 0.1, 0.1))]
    room = fit_room(points, glass, circle().world_from_camera[:, :3, 3])
    meshes = {name: mesh.vertices for name, mesh in room.parts.items()}
    assert room.support == pytest.approx(0, abs=0.005)
    assert {"floor", "table", "wall_0", "wall_1"} <= meshes.keys()
    assert "wall_2" not in meshes
    assert np.abs(meshes["floor"][:, 2] + 0.7).max() < 0.005
    assert np.abs(np.ptp(meshes["table"], axis=0)[:2] - (1, 0.8)).max() < 0.08
    assert meshes["table"][:, 2].max() == pytest.approx(0, abs=0.005)
    fitted = sorted((meshes["wall_0"], meshes["wall_1"]), key=lambda vertices: np.ptp(vertices[:, 0]))
    assert np.abs(fitted[0][:, 0] + 2).max() < 0.03 and np.abs(fitted[1][:, 1] - 2).max() < 0.03


@pytest.mark.parametrize("seed", range(2))
def test_up_is_across_the_plane_that_cameras_look_down_on(seed: int, rotation: np.ndarray) -> None:
    points = room_points(np.random.default_rng(seed)) @ rotation.T
    poses = circle().world_from_camera[:6].copy()  # From one side alone, so that their own up is oblique.
    poses[:, :3] = rotation @ poses[:, :3]
    up = find_up(points, poses)
    assert np.degrees(np.arccos(np.clip(up @ rotation[:, 2], -1, 1))) < 0.5
    own = poses[:, :3, 1].mean(axis=0)
    assert np.degrees(np.arccos(own @ rotation[:, 2] / np.linalg.norm(own))) > 5


# Lenses


def test_a_distorted_picture_is_redrawn_as_a_pinhole_sees_it() -> None:
    bent = TakenLens(
        width=200, height=150, focal=(180, 184), center=(97, 79), radial=(-0.2, 0.05), tangential=(0.003, -0.002)
    )
    lens, remarks = shared_lens([bent], 50)
    assert (lens.width, lens.height) == (50, 38) and "distorted" in remarks[0]
    rows, columns = np.mgrid[:150, :200] + 0.5
    # Where a point of the plane ahead is seen, inverted by Newton's method in a loop of its own.
    points = np.stack([(columns - 97) / 180, (rows - 79) / 184], axis=-1)
    target = np.stack([columns, rows], axis=-1)
    for _ in range(30):
        points = points + (target - bent.pixels(points)) / [180, 184]
    assert np.abs(bent.pixels(points) - target).max() < 1e-6
    ramp = np.clip(np.stack([0.5 + 0.6 * points[..., 0], 0.5 + 0.6 * points[..., 1], 0 * rows + 0.5], axis=-1), 0, 1)
    picture = np.rint(255 * ramp).astype(np.uint8)
    x = (np.arange(50) + 0.5 - 25) / lens.focal
    y = (np.arange(38) + 0.5 - 19) / lens.focal
    found = redrawn(picture, bent, lens).astype(float) / 255
    assert np.abs(found[..., 0] - (0.5 + 0.6 * x)).max() < 0.006
    assert np.abs(found[..., 1] - (0.5 + 0.6 * y)[:, None]).max() < 0.006
    mask = redrawn_mask(points[..., 0] > 0, bent, lens)
    assert np.array_equal(mask, np.tile(x > 0, (38, 1)))


def test_pictures_of_one_pinhole_are_taken_over_as_they_are() -> None:
    taken = TakenLens(width=30, height=20, focal=(33, 33), center=(14, 11))
    lens, remarks = shared_lens([taken, taken], 100)
    assert remarks == [] and (lens.width, lens.height, lens.center) == (30, 20, (14, 11))
    picture = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    assert np.array_equal(redrawn(picture, taken, lens), picture)
    half, _ = shared_lens([taken], 15)
    assert half.center == (7, 5.5) and redrawn(np.full_like(picture, 77), taken, half).min() == 77


def test_a_mask_of_half_the_size_is_not_wider() -> None:
    taken = TakenLens(width=80, height=80, focal=(80, 80), center=(40, 40))
    half, _ = shared_lens([taken], 40)
    y, x = np.indices((80, 80)) + 0.5
    masks = [np.hypot(x - a, y - b) < 24 for a, b in np.random.default_rng(0).uniform(38, 42, (50, 2))]
    areas = [4 * redrawn_mask(mask, taken, half).sum() / mask.sum() for mask in masks]
    assert np.mean(areas) == pytest.approx(1, abs=0.004)  # 1.02 if every pixel that is half covered were set


def test_pictures_of_several_shapes_show_what_all_of_them_see() -> None:
    wide = TakenLens(width=60, height=40, focal=(50, 50), center=(30, 20))
    high = TakenLens(width=40, height=60, focal=(50, 50), center=(20, 30))
    lens, _ = shared_lens([wide, high], 60)
    assert math.tan(lens.fov_x / 2) == pytest.approx(0.4, rel=1e-6) and (lens.width, lens.height) == (60, 40)


def test_a_strong_distortion_is_not_followed_to_where_it_folds_back() -> None:
    bent = TakenLens(width=200, height=150, focal=(100, 100), center=(100, 75), radial=(-0.4,))
    lens, _ = shared_lens([bent], 200)
    x = np.linspace(0, 1, 99)[:, None] * np.tan(lens.fov_x / 2) * [1, 0.75]
    assert (np.diff(bent.pixels(x), axis=0) > 0).all() and np.tan(lens.fov_x / 2) > 0.6


# What is wrong


THIRD = "masks/ball/DSC 0003 é.png"


def edit(root: Path, **more: object) -> None:
    content = json.loads((root / "transforms.json").read_text())
    (root / "transforms.json").write_text(json.dumps({**content, **more}))


def redraw_masks(root: Path, draw: Callable[[int, np.ndarray], np.ndarray]) -> None:
    for view, path in enumerate(sorted((root / "masks" / "ball").iterdir())):
        Image.fromarray(draw(view, np.asarray(Image.open(path)))).save(path)


def square_somewhere(view: int, mask: np.ndarray) -> np.ndarray:
    drawn = np.zeros_like(mask)
    drawn[:4, 8 * (view % 6) : 8 * (view % 6) + 4] = 255
    return drawn


def with_masks_of_other_pictures(root: Path) -> None:
    for path in list((root / "masks" / "ball").iterdir()):
        path.rename(path.with_name(f"other-{path.name}"))


def without_three_masks(root: Path) -> None:
    for place in (3, 4, 5):
        (root / THIRD.replace("3", str(place))).unlink()


def without_glass(root: Path) -> None:
    shutil.rmtree(root / "masks" / "wine glass (1)")
    redraw_masks(root, lambda _, mask: 0 * mask)


def without_pictures(root: Path) -> None:
    (root / "transforms.json").unlink()
    shutil.rmtree(root / "images")


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda root: shutil.rmtree(root / "masks"), "masks: has 0 folders"),
        (without_three_masks, "lacks masks of 3 of 18 pictures (DSC 0003 é.png, DSC 0004 é.png, DSC 0005 é.png)"),
        (lambda root: Image.new("L", (SIDE, SIDE // 2)).save(root / THIRD), "DSC 0003 é.png: is 48 x 24 pixels"),
        (lambda root: (root / THIRD).write_bytes(b"no picture"), "DSC 0003 é.png: not a picture"),
        (with_masks_of_other_pictures, "masks: lacks masks of 18 of 18 pictures"),
        (without_glass, "masks/ball: shows its object in 0 of 15 pictures"),
        (lambda root: redraw_masks(root, lambda _, mask: 255 - mask), "invert them"),
        (lambda root: redraw_masks(root, square_somewhere), "masks/ball: its masks do not meet in space"),
        (without_pictures, "has 0 pictures; expected 3 to"),
        (lambda root: edit(root, is_fisheye=True, k1=0.05), "not a pinhole camera (is_fisheye)"),
        (lambda root: edit(root, fl_x=50.0, w=SIDE, h=2 * SIDE), "its camera is for pictures of 48 x 96 pixels"),
    ],
)
def test_a_gap_in_a_folder_is_named(spoil: Callable[[Path], object], expected: str, own: Path, tmp_path: Path) -> None:
    spoil(own)
    answer = call(f"datagen capture {own} --out {tmp_path / 'out'}")
    assert answer.status == 1 and expected in answer.error
    assert answer.error.count("\n") <= 1 and not (tmp_path / "out").exists()


def test_without_cameras_and_pycolmap_it_says_what_to_install(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    (own / "transforms.json").unlink()
    answer = call(f"datagen capture {own} --out {tmp_path / 'out'}")
    assert answer.status == 1 and "pip install 'hyaline-glass[capture]'" in answer.error
    assert "has no cameras (transforms.json, or COLMAP's sparse/0)" in answer.error


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("--diameter bottle=0.1", "expected an object and its size, as in tumbler=82mm"),
        ("--diameter bottle=10cm", "bottle is not an object; expected one of ball, wine_glass__1_"),
        ("--diameter ball=tall", "expected an object and its size"),
        ("--longest 2", "expected 8 to"),
    ],
)
def test_a_flag_that_cannot_be_is_refused(flags: str, expected: str, folder: Path, tmp_path: Path) -> None:
    answer = call(f"datagen capture '{folder}' --out {tmp_path / 'out'} {flags}")
    assert answer.status == 1 and expected in answer.error


def test_pictures_of_one_size_have_one_lens(tmp_path: Path) -> None:
    colmap = pytest.importorskip("pycolmap", reason="the extra `capture` is not installed")
    for name in ("images", "masks"):
        (tmp_path / name).mkdir()
    for place, size in enumerate(((96, 64), (64, 96)) * 2):
        Image.effect_noise(size, 90).save(tmp_path / "images" / f"{place}.png")
        Image.new("L", size, 255).save(tmp_path / "masks" / f"{place}.png.png")
    with colmap.Database.open(_matched(colmap, tmp_path)) as opened:
        lens_of = {image.name: image.camera_id for image in opened.read_all_images()}
    assert lens_of["0.png"] == lens_of["2.png"] != lens_of["1.png"] == lens_of["3.png"]


def test_pictures_without_masks_do_not_change_which_ones_are_held_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_folder(tmp_path, cameras="none")
    (tmp_path / THIRD.replace("3", "0")).unlink()

    def stop(root: Path, masks: Masks, tests: set[Path]) -> None:
        assert len(masks) == len(find_pictures(root)) - 1 and tests == set(find_pictures(root)[::EVERY])
        raise HyalineError("as it should be")

    monkeypatch.setattr("hyaline_photos.capture.folder.find_cameras", stop)
    with pytest.raises(HyalineError, match="as it should be"):
        read_capture(tmp_path)


def test_a_test_picture_is_placed_before_points_that_training_pictures_show(tmp_path: Path) -> None:
    colmap = pytest.importorskip("pycolmap", reason="the extra `capture` is not installed")
    wanted, database = colmap.SyntheticDatasetOptions(), tmp_path / "database.db"
    wanted.num_rigs, wanted.num_frames_per_rig = 1, 8
    with colmap.Database.open(database) as opened:
        truth = colmap.synthesize_dataset(wanted, opened)
    last = max(image.name for image in truth.images.values())
    options = colmap.IncrementalPipelineOptions()
    options.image_names, options.min_model_size = [i.name for i in truth.images.values() if i.name != last], 3
    found = colmap.incremental_mapping(database, tmp_path, tmp_path, options)[0]
    points = {number: point.xyz.copy() for number, point in found.points3D.items()}
    focal = next(iter(found.cameras.values())).params.copy()
    assert found.find_image_with_name(last) is None
    _place_others(colmap, found, database, {last})
    assert all(np.array_equal(point.xyz, points.pop(number)) for number, point in found.points3D.items())
    assert not points and np.array_equal(next(iter(found.cameras.values())).params, focal)

    def away(model: Any) -> np.ndarray:
        places = {image.name: image.projection_center() for image in model.images.values()}
        others = np.array([places[name] for name in sorted(places) if name != last])
        return np.linalg.norm(others - places[last], axis=1) / np.linalg.norm(others[0] - others[1])

    assert np.allclose(away(found), away(truth), rtol=0.01)


@pytest.mark.full
def test_glasses_with_drinks_that_are_seen_only_through_their_openings_get_places(tmp_path: Path) -> None:
    data, shots, root = tmp_path / "drinks", tmp_path / "shots", tmp_path / "captured"
    size = "--resolution 80 --views 24 --test-views 1 --spp 2 --test-spp 2"
    for words in (
        f"datagen build --scene drinks {size} --out {data}",
        f"datagen export {data} --format capture --out {shots}",
        f"datagen capture {shots} --out {root}",
    ):
        answer = call(words)
        assert answer.status == 0, answer.error
    captured, truth = open_dataset(root), open_scene(open_dataset(data))
    true = {item.name: item.mesh.vertices for item in truth.objects}
    found = {item.name: item.mesh.vertices for item in open_scene(captured).objects}
    for drink, vessel in (("whisky", "tumbler"), ("wine", "wine_glass")):
        for name, most in ((drink, 0.04), (vessel, 0.02)):
            middles = [(each.min(axis=0) + each.max(axis=0))[:2] / 2 for each in (found[name], true[name])]
            assert np.linalg.norm(middles[0] - middles[1]) < most, name
