"""Tests that whatever is wrong in a call of hyaline's functions and records raises a HyalineError of one line."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from support.checked import unchecked
from support.synthetic import write_synthetic_dataset

import hyaline as hy

HUGE, NAN = 10**9, math.nan
PICTURE = np.zeros((16, 16, 3), np.uint8)
EYE = np.eye(4)
BALL = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
WHITE = (1.0, 1.0, 1.0)


def scene(**changes: Any) -> hy.Scene:
    glass = hy.Object("ball", BALL, hy.Dielectric())
    return hy.Scene(**{"objects": [glass], **changes})


def rig(**changes: Any) -> hy.CameraRig:
    walk = (hy.WalkPoint(position=(2, 0, 1), target=(0, 0, 0)), hy.WalkPoint(position=(3, 0, 1), target=(0, 0, 0)))
    return hy.CameraRig(**{"target": (0, 0, 0), "radius": 1.0, "elevation_deg": (5, 60), "walk": walk, **changes})


def camera(**changes: Any) -> hy.Camera:
    matrix = hy.look_at((2, 0, 1), (0, 0, 0))
    return hy.Camera(**{"world_from_camera": matrix, "fov_x": 1.0, "width": 16, "height": 16, **changes})


Given = SimpleNamespace
"""What calls use: a `dataset`, a `view` of it, its `folder`, a `file` that is no dataset."""

CALLS: dict[str, Callable[[Given], object]] = {
    # Finding and opening.
    "open_dataset(3)": lambda _: hy.open_dataset(3),  # pyright: ignore
    "open_dataset of a missing folder": lambda _: hy.open_dataset("/nothing"),
    "open_dataset of a file": lambda g: hy.open_dataset(g.file),
    "open_dataset of a long name": lambda _: hy.open_dataset("a" * 5000),
    "open_dataset of a name with a NUL": lambda _: hy.open_dataset("a\0b"),
    "open_dataset under no folder": lambda _: hy.open_dataset(None, "nothing"),
    "list_datasets(None)": lambda _: hy.list_datasets(None),  # pyright: ignore
    "list_runs(None)": lambda _: hy.list_runs(None),  # pyright: ignore
    "open_run(None)": lambda _: hy.open_run(None),  # pyright: ignore
    "open_run of a missing one": lambda _: hy.open_run("nothing"),
    "open_run of a file": lambda g: hy.open_run(g.file),
    "open_run of a long name": lambda _: hy.open_run("a/" + "b" * 5000),
    # Views.
    "view of no split": lambda g: g.dataset.view("trian", 0),
    "view -1": lambda g: g.dataset.view("train", -1),
    "view 10**9": lambda g: g.dataset.view("train", HUGE),
    "view 0.5": lambda g: g.dataset.view("train", 0.5),
    "views(3)": lambda g: g.dataset.views(3),
    "cameras(None)": lambda g: g.dataset.cameras(None),
    "noise_ceiling_db({})": lambda g: g.dataset.noise_ceiling_db({}),
    "object_id(3)": lambda g: g.dataset.object_id(3),
    "layer_store('..')": lambda g: g.dataset.layer_store("../.."),
    "layers of no geometry": lambda g: g.view.layers("nothing"),
    "object_ids(3)": lambda g: g.view.object_ids(3),
    "mask('water')": lambda g: g.view.mask("water"),
    "show(None)": lambda _: hy.show(None),  # pyright: ignore
    "quantities of a picture": lambda _: hy.quantities(PICTURE),  # pyright: ignore
    "quantities' normal of no kind": lambda g: hy.quantities(g.view).normal("flat", "world"),
    "quantities' normal of no axes": lambda g: hy.quantities(g.view).normal("shading", None),
    "layers of no camera": lambda g: hy.layers(g.dataset, None),
    "layers of a huge camera": lambda g: hy.layers(g.dataset, camera(width=HUGE, height=HUGE)),
    "10**9 layers": lambda g: hy.layers(g.dataset, g.view.camera, num_layers=HUGE),
    # Cameras.
    "orbit(count=0)": lambda _: hy.orbit(camera(), (0, 0, 0), 0),
    "orbit(count=10**8)": lambda _: hy.orbit(camera(), (0, 0, 0), 10**8),
    "orbit around None": lambda _: hy.orbit(camera(), None, 3),  # pyright: ignore
    "orbit around NaN": lambda _: hy.orbit(camera(), (NAN, 0, 0), 3),
    "orbit by NaN": lambda _: hy.orbit(camera(), (0, 0, 0), 3, turn_deg=NAN),
    "look_at of words": lambda _: hy.look_at("here", "there"),  # pyright: ignore
    "look_at of two numbers": lambda _: hy.look_at((1, 2), (0, 0)),  # pyright: ignore
    "look_at of NaN": lambda _: hy.look_at((NAN, 0, 0), (0, 0, 0)),
    "look_at of its own place": lambda _: hy.look_at((1, 1, 1), (1, 1, 1)),
    "intrinsics of NaN": lambda _: hy.camera_from_intrinsics(EYE, np.full((3, 3), NAN), 16, 16),
    "intrinsics of 4 x 4": lambda _: hy.camera_from_intrinsics(EYE, np.eye(4), 16, 16),
    "a pose of 3 x 4": lambda _: hy.camera_from_intrinsics(EYE[:3], np.eye(3), 16, 16),
    "width 0": lambda _: hy.camera_from_intrinsics(EYE, np.eye(3), 0, 16),
    "width 10**9": lambda _: hy.camera_from_intrinsics(EYE, np.diag([1e9, 1e9, 1]), HUGE, HUGE),
    "Camera without a pose": lambda _: hy.Camera(fov_x=1.0, width=16, height=16),  # pyright: ignore
    "rays of a huge camera": lambda _: camera(width=10**6, height=10**6).rays(),
    "project(None)": lambda _: camera().project(None),  # pyright: ignore
    # Scores.
    "score of empty arrays": lambda _: hy.score(PICTURE[:0], PICTURE[:0]),
    "score of floats": lambda _: hy.score(PICTURE / 255, PICTURE),
    "score of other sizes": lambda _: hy.score(PICTURE[:8], PICTURE),
    "score of grey pictures": lambda _: hy.score(PICTURE[..., 0], PICTURE[..., 0]),
    "score with a mask of 0 and 1": lambda _: hy.score(PICTURE, PICTURE, np.ones((16, 16), np.uint8)),
    # Building.
    "build(3)": lambda _: hy.build(3),  # pyright: ignore
    "build of an unknown scene": lambda _: hy.build("glas_table"),
    "build of a missing file": lambda _: hy.build("nothing.glb"),
    "build of a long name": lambda _: hy.build("a" * 5000),
    "build into a file": lambda g: hy.build("glass_table", g.file, preset="tiny"),
    "build(preset='big')": lambda _: hy.build("glass_table", preset="big"),
    "build(resolution=0)": lambda _: hy.build("glass_table", resolution=0),
    "build(resolution=10**9)": lambda _: hy.build("glass_table", resolution=HUGE),
    "build(views=-1)": lambda _: hy.build("glass_table", views=-1),
    "build(views=10**9)": lambda _: hy.build("glass_table", views=HUGE),
    "build(spp=10**12)": lambda _: hy.build("glass_table", spp=10**12),
    "build(ceiling=nan)": lambda _: hy.build("glass_table", ceiling=NAN),
    "build(seed=-1)": lambda _: hy.build("glass_table", seed=-1),
    "build(workers=0)": lambda _: hy.build("glass_table", preset="tiny", workers=0),
    "build(colour='red')": lambda _: hy.build("glass_table", colour="red"),  # pyright: ignore
    "make_proxies(None)": lambda _: hy.make_proxies(None),  # pyright: ignore
    "make_proxies of nothing": lambda _: hy.make_proxies("nothing"),
    "make_proxies of an unknown kind": lambda g: hy.make_proxies(g.dataset, "sphere"),
    "make_proxies of noise nan": lambda g: hy.make_proxies(g.dataset, "noise-nan"),
    "make_proxies with -1 layers": lambda g: hy.make_proxies(g.dataset, "box", num_layers=-1),
    # Training and reports.
    "train(3)": lambda g: hy.train(3, g.dataset),  # pyright: ignore
    "train of an unknown method": lambda g: hy.train("nerf", g.dataset),
    "train on nothing": lambda _: hy.train("paper", "nothing"),
    "train(steps=-1)": lambda g: hy.train("paper", g.dataset, steps=-1),
    "train(lr=nan)": lambda g: hy.train("paper", g.dataset, lr=NAN),
    "train(batch=10**12)": lambda g: hy.train("paper", g.dataset, steps=1, batch=10**12),
    "train(texture_size=10**9)": lambda g: hy.train("paper", g.dataset, steps=1, texture_size=HUGE),
    "train(geometry='nothing')": lambda g: hy.train("paper", g.dataset, geometry="nothing"),
    "train into a file": lambda g: hy.train("paper", g.dataset, out=g.file),
    "train(device='tpu')": lambda g: hy.train("paper", g.dataset, device="tpu"),  # pyright: ignore
    "report(3)": lambda _: hy.report(3),  # pyright: ignore
    "report of nothing": lambda _: hy.report("nothing"),
    "report of none": lambda _: hy.report([]),
    "report of all in no folder": lambda _: hy.report(root="nothing"),
    "report(views=0)": lambda _: hy.report("nothing", views=0),
    "report into a file": lambda g: hy.report("nothing", g.file),
    "ViewDataset(None)": lambda _: hy.ViewDataset(None, "train"),  # pyright: ignore
    "ViewDataset of no split": lambda g: hy.ViewDataset(g.dataset, "trian"),
    "RayDataset of no split": lambda g: hy.RayDataset(g.dataset, None),
    # Scenes.
    "a scene of None": lambda _: scene(objects=None).described(),
    "a scene of meshes": lambda _: scene(objects=[BALL]).described(),
    "a scene of 300 objects": lambda _: scene(objects=300 * [hy.Object("ball", BALL, hy.Dielectric())]),
    "a scene without objects": lambda _: scene(objects=[]),
    "a scene's name is 3": lambda _: scene(name=3).described(),
    "a scene's name is a path": lambda _: scene(name="../up").described(),
    "a scene's light is white": lambda _: scene(light="white").described(),
    "a scene's lamps are words": lambda _: scene(lamps=["lamp"]).described(),
    "a scene's map is missing": lambda _: scene(light=hy.EnvironmentMap(path="sky.exr")).described(),
    "a scene's map is a folder": lambda g: scene(light=hy.EnvironmentMap(path="a.exr"), folder=g.maps).described(),
    "an object's name is None": lambda _: hy.Object(None, BALL, hy.Dielectric()),  # pyright: ignore
    "an object's mesh is None": lambda _: scene(objects=[hy.Object("a", None, hy.Dielectric())]).described(),  # pyright: ignore
    "an object's mesh is empty": lambda _: scene(
        objects=[hy.Object("a", (np.zeros((0, 3)), np.zeros((0, 3), int)), hy.Dielectric())]
    ).described(),
    "an object's mesh is a folder": lambda g: scene(
        objects=[hy.Object("a", g.maps / "a.ply", hy.Dielectric())]
    ).described(),
    "an object's faces are words": lambda _: scene(
        objects=[hy.Object("a", (BALL.vertices, "faces"), hy.Dielectric())]  # pyright: ignore
    ).described(),
    "an object's material is None": lambda _: hy.Object("a", BALL, None),  # pyright: ignore
    "Hemisphere(radius='far')": lambda _: hy.Hemisphere(radius="far"),  # pyright: ignore
    "Hemisphere(radius=nan)": lambda _: hy.Hemisphere(radius=NAN),
    "Hemisphere(elevation_deg=(60, 5))": lambda _: scene(cameras=hy.Hemisphere(elevation_deg=(60, 5))).described(),
    "Hemisphere(target=nan)": lambda _: scene(cameras=hy.Hemisphere(target=(NAN, 0, 0))).described(),
    "CameraRig(walk=None)": lambda _: rig(walk=None),
    "CameraRig(target=2 numbers)": lambda _: rig(target=(0, 0)),
    "WalkPoint of None": lambda _: hy.WalkPoint(position=None, target=(0, 0, 0)),  # pyright: ignore
    "Lobe(radiance=1)": lambda _: hy.Lobe(direction=(0, 0, 1), radiance=1, sharpness=3),  # pyright: ignore
    "Card(size_deg=nan)": lambda _: hy.Card(direction=(0, 0, 1), radiance=WHITE, size_deg=(NAN, 5)),
    "SoftEnvironment(zenith='blue')": lambda _: hy.SoftEnvironment(zenith="blue", horizon=WHITE, ground=WHITE),  # pyright: ignore
    "EnvironmentMap(path='/')": lambda _: hy.EnvironmentMap(path="/etc/passwd"),
    "RectangleLight of a line": lambda _: hy.RectangleLight(
        corner=(0, 0, 1), edge_u=(1, 0, 0), edge_v=(1, 0, 0), radiance=WHITE
    ),
    "RectangleLight at NaN": lambda _: hy.RectangleLight(
        corner=(NAN, 0, 1), edge_u=(1, 0, 0), edge_v=(0, 1, 0), radiance=WHITE
    ),
    "Dielectric(ior='custard')": lambda _: hy.Dielectric(ior="custard"),
    "Dielectric(ior=nan)": lambda _: hy.Dielectric(ior=NAN),
    "Dielectric(absorption=1)": lambda _: hy.Dielectric(absorption=1),  # pyright: ignore
    "Dielectric(priority=1.5)": lambda _: hy.Dielectric(priority=1.5),  # pyright: ignore
    "RoughDielectric(roughness=7)": lambda _: hy.RoughDielectric(roughness=7),
    "Diffuse(color=[5, 5, 5])": lambda _: hy.Diffuse(color=[5, 5, 5]),  # pyright: ignore
    "Diffuse(color=2 numbers)": lambda _: hy.Diffuse(color=(1, 1)),  # pyright: ignore
    "Conductor(roughness=3)": lambda _: hy.Conductor(roughness=3, color=WHITE),  # pyright: ignore
    "SolidTexture of no pattern": lambda _: hy.SolidTexture(pattern="dots", colors=(WHITE, WHITE), scale=1),  # pyright: ignore
    "ImageTexture(path=3)": lambda _: hy.ImageTexture(path=3),  # pyright: ignore
    "Mesh of lists": lambda _: hy.Mesh(vertices=[], faces=[], normals=[], uv=[]),  # pyright: ignore
}
"""Calls by what is wrong with them."""


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Given:
    home = tmp_path_factory.mktemp("home")
    write_synthetic_dataset(home / "data" / "glass_table")
    (home / "file").write_text("no dataset")
    (home / "maps" / "a.exr").mkdir(parents=True)
    (home / "maps" / "a.ply").mkdir()
    dataset = hy.open_dataset(home / "data" / "glass_table")
    return Given(dataset=dataset, view=dataset.view("train", 0), file=home / "file", maps=home / "maps")


@pytest.mark.parametrize("what", CALLS)
def test_a_bad_call_raises_a_hyaline_error_of_one_line(what: str, given: Given) -> None:
    with unchecked(), pytest.raises(hy.HyalineError) as caught:
        CALLS[what](given)
    assert str(caught.value) and "\n" not in str(caught.value)
