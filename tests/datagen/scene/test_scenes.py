import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.meshes import corner_cosines, gutter_violations

from datagen.data.meshes import Mesh
from datagen.data.paths import BUILT_IN_SCENES
from datagen.scene.atlas import coverage
from datagen.scene.builtin import make_scene
from datagen.scene.description import Scene
from datagen.scene.folder import load_scene, save_scene, scene_files
from datagen.scene.soundness import check_scene

_made: dict[str, Scene] = {}


@pytest.fixture(params=BUILT_IN_SCENES)
def scene(request: pytest.FixtureRequest) -> Scene:
    """Each built-in scene, made once a session."""
    if request.param not in _made:
        _made[request.param] = make_scene(request.param)
    return _made[request.param]


TWO = pytest.mark.parametrize(
    "scene",
    [
        pytest.param(name, marks=() if name in ("prism_bench", "vitrine") else pytest.mark.full)
        for name in BUILT_IN_SCENES
    ],
    indirect=True,
)
"""These two have all kinds of materials; the others only have more faces."""


def test_scene_is_valid_and_within_its_budget(scene: Scene) -> None:
    check_scene(scene)
    assert 30_000 <= sum(len(item.mesh.faces) for item in scene.objects) <= 140_000
    assert all(item.name == item.name.lower() for item in scene.objects)
    assert any(item.material.is_glass for item in scene.objects)


def test_shading_normals_stand_on_the_side_that_faces_show(scene: Scene) -> None:
    for item in scene.objects:
        cosines = corner_cosines(item.mesh)
        assert cosines.min() > 0.3, (item.name, cosines.min())
        if item.material.is_glass:
            assert cosines.min() > 0.7, (item.name, cosines.min())


@TWO
def test_atlases_do_not_overlap_and_charts_keep_a_gutter(scene: Scene) -> None:
    for item in scene.objects:
        counts = coverage(item.mesh, 512)
        assert counts.max() == 1, (item.name, int((counts > 1).sum()))
        assert (counts > 0).mean() > 0.12, item.name
        assert gutter_violations(item.mesh, 512) == 0, item.name


def test_a_scene_is_made_again_byte_for_byte() -> None:
    if "vitrine" not in _made:
        _made["vitrine"] = make_scene("vitrine")
    assert scene_files(make_scene("vitrine")) == scene_files(_made["vitrine"])


@TWO
def test_saving_and_loading_gives_the_same_scene(scene: Scene, tmp_path: Path) -> None:
    save_scene(scene, tmp_path)
    loaded = load_scene(tmp_path)
    for field in ("name", "description", "environment", "lights", "cameras"):
        assert getattr(loaded, field) == getattr(scene, field)
    for before, after in zip(scene.objects, loaded.objects, strict=True):
        assert (before.name, before.material) == (after.name, after.material)
        for array in dataclasses.fields(Mesh):
            np.testing.assert_array_equal(getattr(before.mesh, array.name), getattr(after.mesh, array.name))
