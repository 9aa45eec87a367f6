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

NAN = math.nan
PICTURE = np.zeros((16, 16, 3), np.uint8)
EYE = np.eye(4)
BALL = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
WHITE = (1.0, 1.0, 1.0)


def scene(**changes: Any) -> hy.Scene:
    glass = hy.Object("ball", BALL, hy.Dielectric())
    return hy.Scene(**{"objects": [glass], **changes})


Given = SimpleNamespace
"""What calls use: a `dataset`, a `view` of it, its `folder`, a `file` that is no dataset."""

CALLS: dict[str, Callable[[Given], object]] = {
    # Finding and opening.
    "open_dataset of a file": lambda g: hy.open_dataset(g.file),
    "open_run of a long name": lambda _: hy.open_run("a/" + "b" * 5000),
    # Views.
    "view of no split": lambda g: g.dataset.view("trian", 0),
    "layer_store('..')": lambda g: g.dataset.layer_store("../.."),
    "quantities' normal of no kind": lambda g: hy.quantities(g.view).normal("flat", "world"),
    # Cameras.
    "intrinsics of NaN": lambda _: hy.camera_from_intrinsics(EYE, np.full((3, 3), NAN), 16, 16),
    # Scores.
    "score of other sizes": lambda _: hy.score(PICTURE[:8], PICTURE),
    # Building.
    "build of an unknown scene": lambda _: hy.build("glas_table"),
    "build into a file": lambda g: hy.build("glass_table", g.file, preset="tiny"),
    "make_proxies of an unknown kind": lambda g: hy.make_proxies(g.dataset, "sphere"),
    # Training and reports.
    "RayDataset of no split": lambda g: hy.RayDataset(g.dataset, None),
    # Scenes.
    "a scene's name is a path": lambda _: scene(name="../up").described(),
    "a scene's map is a folder": lambda g: scene(light=hy.EnvironmentMap(path="a.exr"), folder=g.maps).described(),
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
    "Hemisphere(elevation_deg=(60, 5))": lambda _: scene(cameras=hy.Hemisphere(elevation_deg=(60, 5))).described(),
    "Dielectric(ior='custard')": lambda _: hy.Dielectric(ior="custard"),
    "Plastic(ior='air')": lambda _: hy.Plastic(color=(0.5, 0.5, 0.5), ior="air"),
    "SolidTexture of no pattern": lambda _: hy.SolidTexture(pattern="dots", colors=(WHITE, WHITE), scale=1),  # pyright: ignore
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
