"""Tests what is mended of surfaces, that holes in glass are closed, and that the volume is kept or the file refused."""

import dataclasses
import warnings
from pathlib import Path

import numpy as np
import pytest
from support.foreign import add, glass_entry, taken
from support.gltf import BOX, glass_of
from support.meshes import inside_out

from datagen.data.meshes import MIN_AREA, Mesh, face_areas, mesh_from, open_edges, signed_volume, welded
from datagen.data.queries import check_closed
from datagen.disk.errors import HyalineError
from datagen.scene.finding import ImportChoices
from datagen.scene.materials import Dielectric, ThinDielectric
from datagen.scene.modelling import ball, merged, moved
from datagen.scene.shading_normals import opposing_share
from hyaline_import.importing import import_scene
from hyaline_import.remarks import Remarks
from hyaline_import.surfaces import closed, mend_surface

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


def test_what_closing_would_change_and_what_cannot_be_closed_is_refused() -> None:
    upper = BALL.vertices[BALL.faces][..., 2].min(axis=1) > -0.02
    with pytest.raises(HyalineError, match=r"1 holes closed: its volume was .* % off; expected at most 5 %"):
        closed(without(BALL, np.flatnonzero(~upper).tolist()), Remarks(), where="ball")
    fin = np.array([[*BALL.faces[0, :2], 500]], np.int32)  # Where three faces meet at an edge.
    with pytest.raises(HyalineError, match="edges stay open"):
        closed(dataclasses.replace(BALL, faces=np.concatenate([BALL.faces, fin])), Remarks(), where="ball")


def test_open_glass_of_a_file_is_thin_and_solid_when_repaired(tmp_path: Path) -> None:
    holed = without(BOX, [3])
    assert open_edges(holed)
    builder = glass_of(holed, name="block")
    path = builder.written(tmp_path)
    assert isinstance(import_scene(path, ImportChoices()).scene.objects[0].material, ThinDielectric)
    done = import_scene(path, ImportChoices(repair=True))
    assert isinstance(done.scene.objects[0].material, Dielectric)
    assert "1 holes closed" in done.record["approximations"][0]


def with_split_edges(mesh: Mesh, *, bridged: bool) -> Mesh:
    """The mesh with an edge of every eighth face split on its side only; faces without area may bridge the cracks."""
    positions, triangles = welded(mesh)
    found, faces, split = [*positions], triangles.tolist(), set()
    for index in range(0, len(triangles), 8):
        a, b, c = faces[index]
        if frozenset((a, b)) in split:
            continue
        split.add(frozenset((a, b)))
        middle = len(found)
        found.append((found[a] + found[b]) / 2)
        faces[index] = [a, middle, c]
        faces += [[middle, b, c], *[[a, b, middle]] * bridged]
    return mesh_from(np.array(found), np.array(faces))


@pytest.mark.parametrize("bridged", [True, False])
@pytest.mark.parametrize("repair", ["", "--repair"])
def test_slivers_are_collapsed_so_that_closed_glass_stays_closed(bridged: bool, repair: str, tmp_path: Path) -> None:
    mesh = with_split_edges(BOX, bridged=bridged)
    assert (face_areas(mesh).min() < MIN_AREA) == bridged and (open_edges(mesh) == 0) == bridged
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        block = taken(glass_of(mesh, name="block").written(tmp_path), repair)["block"]
    assert raised == []
    if repair or bridged:
        assert block.material == Dielectric(ior=1.5) and open_edges(block.mesh) == 0
        assert signed_volume(block.mesh) == pytest.approx(signed_volume(BOX), rel=1e-5)
        assert len(block.mesh.faces) <= len(mesh.faces) + (0 if bridged else len(BOX.faces) // 8 + 1)
    else:
        assert isinstance(block.material, ThinDielectric)


def test_repair_leaves_out_the_object_that_cannot_be_closed(tmp_path: Path) -> None:
    bowl = without(BALL, np.flatnonzero(BALL.vertices[BALL.faces][..., 2].min(axis=1) <= -0.02).tolist())
    builder = add(glass_of(BALL, name="ball"), "bowl", bowl, glass_entry(), translation=[0.3, 0, 0])
    done = taken(builder.written(tmp_path), "--scale 1 --repair")
    assert "bowl: left out, since it cannot be mended: 1 holes closed" in done.err
    assert [item.name for item in done.scene.objects] == ["ball", "ground"]


@pytest.mark.parametrize("repair", ["", "--repair"])
def test_overlapping_parts_become_objects_and_keep_their_cavities(repair: str, tmp_path: Path) -> None:
    outer, inner = ball(0.1, subdivisions=3), ball(0.05, subdivisions=3)
    cavity = inside_out(inner)
    path = glass_of(merged([outer, cavity, moved(outer, (0.17, 0.0, 0.0))]), name="pair").written(tmp_path)
    done = taken(path, f"--scale 1 {repair}")
    hollow = signed_volume(outer) - signed_volume(inner)
    volumes = [signed_volume(done[name].mesh) for name in ("pair_part0", "pair_part1")]
    assert volumes == pytest.approx([hollow, signed_volume(outer)], rel=1e-3)


# Surfaces

ROUND = ball(0.3, subdivisions=2)
A, B, C = ROUND.faces[0].tolist()
LONELY = Mesh(
    vertices=np.concatenate([ROUND.vertices, np.float32([[0, 0, 90]])]),
    faces=ROUND.faces,
    normals=np.concatenate([ROUND.normals, np.float32([[np.nan] * 3])]),
    uv=np.concatenate([ROUND.uv, np.float32([[7, 7]])]),
)


def with_faces(*more: tuple[int, int, int]) -> Mesh:
    return dataclasses.replace(ROUND, faces=np.concatenate([ROUND.faces, np.array(more, np.int32)]))


def with_normals(count: int, factor: float) -> Mesh:
    factors = np.where(np.arange(len(ROUND.normals)) < count, factor, 1)[:, None]
    return dataclasses.replace(ROUND, normals=(ROUND.normals * factors).astype(np.float32))


@pytest.mark.parametrize(
    ("mesh", "is_solid", "remark"),
    [
        (with_normals(1000, -1), True, "100.0 % of its vertex normals pointed to the back of their faces"),
        (with_normals(1000, 0), True, "100.0 % of its vertex normals were 0 or not finite"),
        (with_normals(1, np.nan), True, "1 of its vertex normals were 0 or not finite; these were computed again"),
        (with_faces((A, A, A)), True, "1 of its faces have no area; they were left out"),
        (with_faces((A, A, B)), True, "1 of its faces have no area; they were left out"),
        (with_faces((B, C, A)), True, "1 of its faces are there twice; they were left out"),
        (with_faces((B, A, C)), False, "1 of its faces are there twice; they were left out"),
        (LONELY, True, "1 of its vertices belong to no face; they were left out"),
    ],
)
def test_a_surface_is_mended_and_a_line_says_what_was_wrong(mesh: Mesh, is_solid: bool, remark: str) -> None:
    remarks = Remarks()
    found = mend_surface(mesh, remarks, is_solid=is_solid, where="thing")
    assert len(remarks.lines) == 1 and remarks.lines[0].what.startswith(remark)
    check_closed(found, where="thing")
    assert len(found.faces) == len(ROUND.faces)
    assert opposing_share(found) == 0
    outward = found.vertices / np.linalg.norm(found.vertices, axis=-1, keepdims=True)
    assert np.einsum("vc,vc->v", outward, found.normals).min() > 0.98
    assert mend_surface(found, remarks, is_solid=is_solid, where="thing") is found and len(remarks.lines) == 1
