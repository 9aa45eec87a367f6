"""Tests that holes in glass are closed, that the volume is kept or the file refused, and that both are said."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.gltf import BOX, GltfBuilder, clear, glass

from datagen.data.meshes import Mesh, open_edges, signed_volume
from datagen.data.windings import check_closed
from datagen.disk.errors import HyalineError
from datagen.scene.importers.choices import ImportChoices
from datagen.scene.importers.importing import import_scene
from datagen.scene.importers.remarks import Remarks
from datagen.scene.importers.repair import closed
from datagen.scene.materials import Dielectric, ThinDielectric
from datagen.scene.modelling import ball

BALL = ball(0.1, subdivisions=3)


def without(mesh: Mesh, faces: list[int]) -> Mesh:
    return dataclasses.replace(mesh, faces=np.delete(mesh.faces, faces, axis=0))


def around(mesh: Mesh, vertex: int) -> list[int]:
    """The faces at a vertex."""
    return np.flatnonzero((mesh.faces == vertex).any(axis=1)).tolist()


HOLES = {
    "one face": [5],
    "two faces apart": [5, 700],
    "two that touch in a point": [around(BALL, 300)[0], around(BALL, 300)[3]],
    "all at a vertex": around(BALL, 300),
    "many": list(range(0, 1280, 97)),
}


@pytest.mark.parametrize("name", HOLES)
def test_holes_are_closed_and_the_volume_stays(name: str) -> None:
    remarks = Remarks()
    whole = closed(without(BALL, HOLES[name]), remarks, where="ball")
    check_closed(whole, where="ball")
    assert signed_volume(whole) == pytest.approx(signed_volume(BALL), rel=0.02)
    np.testing.assert_allclose(np.linalg.norm(whole.normals, axis=-1), 1, atol=1e-5)
    assert [line.is_approximation for line in remarks.lines] == [True]
    assert f"{1e6 * signed_volume(whole):.4g} cm^3" in remarks.lines[0].what


def test_a_mesh_without_holes_stays_as_it_is() -> None:
    remarks = Remarks()
    assert closed(BALL, remarks, where="ball") is BALL
    assert remarks.lines == []


def test_half_a_ball_is_refused_since_closing_it_would_change_what_it_is() -> None:
    upper = BALL.vertices[BALL.faces][..., 2].min(axis=1) > -0.02
    with pytest.raises(HyalineError, match=r"1 holes closed: its volume was .* % off; expected at most 5 %"):
        closed(without(BALL, np.flatnonzero(~upper).tolist()), Remarks(), where="ball")


def test_where_three_faces_meet_at_an_edge_it_is_refused() -> None:
    fin = np.array([[*BALL.faces[0, :2], 500]], np.int32)
    with pytest.raises(HyalineError, match="edges stay open"):
        closed(dataclasses.replace(BALL, faces=np.concatenate([BALL.faces, fin])), Remarks(), where="ball")


def test_open_glass_of_a_file_is_thin_and_solid_when_repaired(tmp_path: Path) -> None:
    builder = GltfBuilder()
    material = builder.material(pbrMetallicRoughness=clear(), extensions=glass())
    holed = without(BOX, [3])
    assert open_edges(holed)
    builder.node(mesh=builder.mesh(holed, material=material), name="block")
    path = builder.written(tmp_path)
    assert isinstance(import_scene(path, ImportChoices()).scene.objects[0].material, ThinDielectric)
    done = import_scene(path, ImportChoices(repair=True))
    assert isinstance(done.scene.objects[0].material, Dielectric)
    assert "1 holes closed" in done.record["approximations"][0]
    with pytest.raises(HyalineError, match="leave out --strict"):
        import_scene(path, ImportChoices(repair=True, strict=True))
