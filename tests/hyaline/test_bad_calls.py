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
    "open_dataset under no folder": lambda _: hy.open_dataset(None, "nothing"),
    "list_datasets(None)": lambda _: hy.list_datasets(None),  # pyright: ignore
    "open_run(None)": lambda _: hy.open_run(None),  # pyright: ignore
    "open_run of a missing one": lambda _: hy.open_run("nothing"),
    "open_run of a file": lambda g: hy.open_run(g.file),
    "open_run of a long name": lambda _: hy.open_run("a/" + "b" * 5000),
    # Views.
    "view of no split": lambda g: g.dataset.view("trian", 0),
    "view -1": lambda g: g.dataset.view("train", -1),
    "layer_store('..')": lambda g: g.dataset.layer_store("../.."),
    "layers of no geometry": lambda g: g.view.layers("nothing"),
    "mask('water')": lambda g: g.view.mask("water"),
    "quantities' normal of no kind": lambda g: hy.quantities(g.view).normal("flat", "world"),
    "quantities' normal of no axes": lambda g: hy.quantities(g.view).normal("shading", None),
    "layers of no camera": lambda g: hy.layers(g.dataset, None),
    "10**9 layers": lambda g: hy.layers(g.dataset, g.view.camera, num_layers=HUGE),
    # Cameras.
    "orbit(count=0)": lambda _: hy.orbit(camera(), (0, 0, 0), 0),
    "orbit around NaN": lambda _: hy.orbit(camera(), (NAN, 0, 0), 3),
    "look_at of two numbers": lambda _: hy.look_at((1, 2), (0, 0)),  # pyright: ignore
    "look_at of its own place": lambda _: hy.look_at((1, 1, 1), (1, 1, 1)),
    "intrinsics of NaN": lambda _: hy.camera_from_intrinsics(EYE, np.full((3, 3), NAN), 16, 16),
    "a pose of 3 x 4": lambda _: hy.camera_from_intrinsics(EYE[:3], np.eye(3), 16, 16),
    "width 10**9": lambda _: hy.camera_from_intrinsics(EYE, np.diag([1e9, 1e9, 1]), HUGE, HUGE),
    "Camera without a pose": lambda _: hy.Camera(fov_x=1.0, width=16, height=16),  # pyright: ignore
    # Scores.
    "score of floats": lambda _: hy.score(PICTURE / 255, PICTURE),
    "score of other sizes": lambda _: hy.score(PICTURE[:8], PICTURE),
    "score with a mask of 0 and 1": lambda _: hy.score(PICTURE, PICTURE, np.ones((16, 16), np.uint8)),
    # Building.
    "build of an unknown scene": lambda _: hy.build("glas_table"),
    "build of a missing file": lambda _: hy.build("nothing.glb"),
    "build into a file": lambda g: hy.build("glass_table", g.file, preset="tiny"),
    "build(preset='big')": lambda _: hy.build("glass_table", preset="big"),
    "build(resolution=10**9)": lambda _: hy.build("glass_table", resolution=HUGE),
    "build(views=-1)": lambda _: hy.build("glass_table", views=-1),
    "build(spp=10**12)": lambda _: hy.build("glass_table", spp=10**12),
    "build(seed=-1)": lambda _: hy.build("glass_table", seed=-1),
    "build(workers=0)": lambda _: hy.build("glass_table", preset="tiny", workers=0),
    "make_proxies of nothing": lambda _: hy.make_proxies("nothing"),
    "make_proxies of an unknown kind": lambda g: hy.make_proxies(g.dataset, "sphere"),
    "make_proxies with -1 layers": lambda g: hy.make_proxies(g.dataset, "box", num_layers=-1),
    # Training and reports.
    "train of an unknown method": lambda g: hy.train("nerf", g.dataset),
    "train(steps=-1)": lambda g: hy.train("paper", g.dataset, steps=-1),
    "train(texture_size=10**9)": lambda g: hy.train("paper", g.dataset, steps=1, texture_size=HUGE),
    "train into a file": lambda g: hy.train("paper", g.dataset, out=g.file),
    "train(device='tpu')": lambda g: hy.train("paper", g.dataset, device="tpu"),  # pyright: ignore
    "report of nothing": lambda _: hy.report("nothing"),
    "report of all in no folder": lambda _: hy.report(root="nothing"),
    "report(views=0)": lambda _: hy.report("nothing", views=0),
    "report into a file": lambda g: hy.report("nothing", g.file),
    "ViewDataset of no split": lambda g: hy.ViewDataset(g.dataset, "trian"),
    "RayDataset of no split": lambda g: hy.RayDataset(g.dataset, None),
    # Scenes.
    "a scene of meshes": lambda _: scene(objects=[BALL]).described(),
    "a scene of 300 objects": lambda _: scene(objects=300 * [hy.Object("ball", BALL, hy.Dielectric())]),
    "a scene without objects": lambda _: scene(objects=[]),
    "a scene's name is a path": lambda _: scene(name="../up").described(),
    "a scene's light is white": lambda _: scene(light="white").described(),
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
    "Card(size_deg=nan)": lambda _: hy.Card(direction=(0, 0, 1), radiance=WHITE, size_deg=(NAN, 5)),
    "SoftEnvironment(zenith='blue')": lambda _: hy.SoftEnvironment(zenith="blue", horizon=WHITE, ground=WHITE),  # pyright: ignore
    "EnvironmentMap(path='/')": lambda _: hy.EnvironmentMap(path="/etc/passwd"),
    "RectangleLight of a line": lambda _: hy.RectangleLight(
        corner=(0, 0, 1), edge_u=(1, 0, 0), edge_v=(1, 0, 0), radiance=WHITE
    ),
    "Dielectric(ior='custard')": lambda _: hy.Dielectric(ior="custard"),
    "Dielectric(ior=nan)": lambda _: hy.Dielectric(ior=NAN),
    "Dielectric(priority=1.5)": lambda _: hy.Dielectric(priority=1.5),  # pyright: ignore
    "RoughDielectric(roughness=7)": lambda _: hy.RoughDielectric(roughness=7),
    "Diffuse(color=[5, 5, 5])": lambda _: hy.Diffuse(color=[5, 5, 5]),  # pyright: ignore
    "Conductor(roughness=3)": lambda _: hy.Conductor(roughness=3, color=WHITE),  # pyright: ignore
    "SolidTexture of no pattern": lambda _: hy.SolidTexture(pattern="dots", colors=(WHITE, WHITE), scale=1),  # pyright: ignore
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
