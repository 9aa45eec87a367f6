"""Tests that surfaces are reduced to fewer triangles, keep their shape or are refused, and that both are said."""

from pathlib import Path

import numpy as np
import pytest
from support.gltf import GltfBuilder, clear, glass

from datagen.data.meshes import open_edges, signed_volume
from datagen.data.ply import write_ply
from datagen.disk.errors import HyalineError
from datagen.scene.import_choices import ImportChoices
from datagen.scene import surfaces
from datagen.scene.importers.foreign import substance_of
from datagen.scene.importers.importing import import_scene
from datagen.scene.modelling import ball
from datagen.scene.remarks import Remarks
from datagen.scene.surfaces import check_decimation, decimated

BALL = ball(0.1, subdivisions=4)

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def test_a_ball_of_a_tenth_of_its_triangles_is_closed_and_as_large() -> None:
    pytest.importorskip("pymeshlab")
    remarks = Remarks()
    few = decimated(BALL, 512, remarks, where="ball")
    assert 500 <= len(few.faces) <= 512 < len(BALL.faces) and open_edges(few) == 0
    assert signed_volume(few) == pytest.approx(signed_volume(BALL), rel=0.02)
    np.testing.assert_allclose(np.linalg.norm(few.normals, axis=-1), 1, atol=1e-5)
    (line,) = remarks.lines
    assert line.is_approximation and line.what.startswith(f"reduced from {len(BALL.faces):,} to {len(few.faces)} tri")
    assert f"is {1e6 * signed_volume(few):.4g} cm^3" in line.what


def test_a_surface_that_has_no_more_triangles_stays_as_it_is() -> None:
    assert decimated(BALL, len(BALL.faces), Remarks(), where="ball") is BALL


def test_what_comes_out_open_or_of_another_size_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(scale: float, left_out: int) -> None:
        arrays = {"vertices": scale * BALL.vertices, "faces": BALL.faces[left_out:]}
        monkeypatch.setattr(surfaces, "arrays_from_child", lambda *_, **__: arrays)

    answer(0.9, 0)
    with pytest.raises(HyalineError, match=r"ball: reduced .*cm\^3, 27.1 % off; expected at most 5 %"):
        decimated(BALL, 100, Remarks(), where="ball")
    answer(1.0, 1)
    with pytest.raises(HyalineError, match="and 3 edges are open then; pass more --max-triangles"):
        decimated(BALL, 100, Remarks(), where="ball")
    answer(1.0, len(BALL.faces) - 1)
    with pytest.raises(HyalineError, match="nothing is left of it with 100 triangles"):
        decimated(BALL, 100, Remarks(), where="ball")


def test_a_number_that_cannot_be_and_a_machine_without_pymeshlab_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(HyalineError, match="--max-triangles: is 10; expected at least 64"):
        check_decimation(10)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(HyalineError, match=r"--max-triangles: needs pymeshlab; `pip install .*\[proxies\]"):
        check_decimation(1000)
    check_decimation(None)


def test_an_import_is_reduced_as_a_whole(tmp_path: Path) -> None:
    pytest.importorskip("pymeshlab")
    (tmp_path / "ball.ply").write_bytes(write_ply(BALL))
    choices = ImportChoices(max_triangles=800, material=("glass",), ground="never")
    imported = import_scene(tmp_path / "ball.ply", choices)
    (item,) = imported.scene.objects
    assert len(item.mesh.faces) <= 800 and item.material.is_glass and np.ptp(item.mesh.uv) > 0.5
    assert any("reduced from 5,120" in line for line in imported.told())


# Indices of refraction


@pytest.mark.parametrize(
    ("name", "substance"),
    [
        ("Diamond", "diamond"), ("water.001", "water"), ("Material_BK7", "bk7"), ("Fused Silica", "fused-silica"),
        ("water bottle", None), ("diamondplate", None), ("air", None), ("glass", None), ("", None), ("001", None),
    ],
)  # fmt: skip
def test_a_name_is_a_substance_when_it_says_nothing_else(name: str, substance: str | None) -> None:
    assert substance_of(name) == substance


@pytest.mark.parametrize(
    ("name", "more", "ior"),
    [
        ("Diamond", {}, 2.417),
        ("Diamond", {"KHR_materials_ior": {"ior": 1.7}}, 1.7),
        ("vase", {}, 1.5),
        ("shell", {"KHR_materials_ior": {"ior": 1.0}}, 1.0),
    ],
)
def test_glass_without_an_index_is_the_substance_of_its_name(tmp_path: Path, name: str, more: dict, ior: float) -> None:
    builder = GltfBuilder()
    material = builder.material(name, pbrMetallicRoughness=clear(), extensions={**glass(), **more})
    builder.node(mesh=builder.mesh(material=material))
    imported = import_scene(builder.written(tmp_path), ImportChoices(ground="never"))
    assert imported.scene.objects[0].material.surface().ior == ior
    assert any("by its name it is diamond, 2.417" in line for line in imported.told()) == (ior == 2.417)
