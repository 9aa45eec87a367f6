"""Tests that a pattern is named when textures are too coarse for it, and only where pictures show it."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import synthetic_scene, write_synthetic_dataset
from torch import nn

from datagen.build.build import build_dataset
from datagen.data.cameras import Cameras, look_at
from datagen.data.paths import TRUTH
from datagen.scene.description import SceneObject
from datagen.scene.materials import Diffuse
from datagen.scene.modelling import sheet
from datagen.scene.textures import SolidTexture
from model.nets.texture import NeuralTextures, TexturePyramid, object_layout
from model.run.preparation import finest_widths, texels_of_period, told_fine_patterns

PERIOD = 0.05
SHEET = sheet((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), cells=(4, 4))
FLOOR = SceneObject(
    name="floor",
    mesh=dataclasses.replace(SHEET, uv=0.25 + 0.5 * (SHEET.vertices[:, :2] + np.float32(0.5))),
    material=Diffuse(color=SolidTexture(pattern="checker", colors=((0, 0, 0), (1, 1, 1)), scale=PERIOD)),
)


def cameras(distance: float) -> Cameras:
    pose = look_at(np.array([0.001, 0.0, distance]), np.zeros(3))[None]
    return Cameras(world_from_camera=pose, fov_x=0.7, width=128, height=128)


@pytest.mark.parametrize("width", [16, 32, 256])
def test_a_metre_has_as_many_texels_as_its_share_of_the_atlas_and_a_period_its_part_of_them(width: int) -> None:
    # A metre of the sheet lies on half of the atlas's side.
    assert texels_of_period(FLOOR, width, cameras(1.5)) == pytest.approx(PERIOD * width / 2, rel=1e-5)


def test_nobody_misses_a_pattern_that_no_picture_resolves_or_that_is_none() -> None:
    assert texels_of_period(FLOOR, 16, cameras(8.0)) == math.inf
    plain = dataclasses.replace(FLOOR, material=Diffuse(color=(0.5, 0.5, 0.5)))
    assert texels_of_period(plain, 16, cameras(1.5)) == math.inf


def test_a_line_names_the_patterns_and_the_width_that_holds_them(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "plain", resolution=16, train_views=2)
    renderer = NeuralTextures(object_layout([8] * len(dataset.objects)), 2)
    assert told_fine_patterns(dataset, TRUTH, renderer) == []
    scene = synthetic_scene()
    coarse = SolidTexture(pattern="checker", colors=((0, 0, 0), (1, 1, 1)), scale=0.3)
    floor = dataclasses.replace(scene.objects[1], material=Diffuse(color=coarse))
    scene = dataclasses.replace(scene, objects=(scene.objects[0], floor))
    dataset = build_dataset(scene, tmp_path / "fine", dataset.config, num_layers=2, workers=1, overwrite=False)
    texels = texels_of_period(floor, 8, dataset.cameras("train"))
    (line,) = told_fine_patterns(dataset, TRUTH, renderer)
    assert f"{floor.name} ({texels:.2g} texels); {math.ceil(16 / texels)} texels across resolve them all" in line
    wide = NeuralTextures(object_layout([math.ceil(16 / texels)] * len(dataset.objects)), 2)
    assert told_fine_patterns(dataset, TRUTH, wide) == []


def test_textures_of_several_copies_and_levels_count_once_by_their_finest() -> None:
    layouts = [object_layout([size >> level for size in (16, 8) for _ in range(3)]) for level in range(2)]
    renderer = nn.ModuleList([TexturePyramid(layouts, 2), NeuralTextures(object_layout([4, 12]), 2), nn.Linear(2, 2)])
    assert finest_widths(renderer, 2) == [16, 12]
    assert finest_widths(nn.Linear(2, 2), 2) == []
