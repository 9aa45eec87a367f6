"""Tests that holes in glass are closed, that the volume is kept or the file refused, and that both are said."""

import dataclasses
import itertools
import warnings
from pathlib import Path

import numpy as np
import pytest
from support.commands import call
from support.gltf import BOX, GltfBuilder, clear, glass, glass_of

from datagen.data.meshes import (
    MIN_AREA,
    Mesh,
    check_closed,
    face_areas,
    open_edges,
    signed_volume,
    vertex_normals,
    welded,
)
from datagen.disk.errors import HyalineError
from datagen.disk.records import load_json
from datagen.scene.folder import load_scene
from datagen.scene.import_choices import ImportChoices
from datagen.scene.materials import Dielectric, ThinDielectric
from datagen.scene.modelling import ball, merged, moved
from datagen.scene.remarks import Remarks
from datagen.scene.surfaces import closed
from hyaline_import.importing import import_scene

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
    holed = without(BOX, [3])
    assert open_edges(holed)
    builder = glass_of(holed, name="block")
    path = builder.written(tmp_path)
    assert isinstance(import_scene(path, ImportChoices()).scene.objects[0].material, ThinDielectric)
    done = import_scene(path, ImportChoices(repair=True))
    assert isinstance(done.scene.objects[0].material, Dielectric)
    assert "1 holes closed" in done.record["approximations"][0]
    with pytest.raises(HyalineError, match="leave out --strict"):
        import_scene(path, ImportChoices(repair=True, strict=True))


def with_split_edges(mesh: Mesh, *, bridged: bool) -> Mesh:
    """The mesh with every eighth face halved, so that a point lies on its neighbour's edge.

    Args:
        bridged: a face without area closes each of these cracks.
    """
    positions, triangles = welded(mesh)
    points, faces, split = list(positions), triangles.tolist(), set()
    for index in range(0, len(triangles), 8):
        a, b, c = faces[index]
        if {a, b} in split:
            continue
        split.add(frozenset((a, b)))
        middle = len(points)
        points.append((points[a] + points[b]) / 2)
        faces[index] = [a, middle, c]
        faces += [[middle, b, c], *([[a, b, middle]] if bridged else [])]
    vertices, corners = np.array(points, np.float32), np.array(faces, np.int32)
    normals = vertex_normals(vertices, corners).astype(np.float32)
    return Mesh(vertices=vertices, faces=corners, normals=normals, uv=np.zeros((len(vertices), 2), np.float32))


@pytest.mark.parametrize("bridged", [True, False])
@pytest.mark.parametrize("repair", ["", "--repair"])
def test_slivers_are_collapsed_so_that_closed_glass_stays_closed(bridged: bool, repair: str, tmp_path: Path) -> None:
    mesh = with_split_edges(BOX, bridged=bridged)
    assert (face_areas(mesh).min() < MIN_AREA) == bridged and (open_edges(mesh) == 0) == bridged
    builder = glass_of(mesh, name="block")
    path = builder.written(tmp_path)
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        answer = call(f"datagen import {path} --out {tmp_path / 'out'} {repair}")
    assert answer.status == 0 and raised == [], answer.err
    block = load_scene(tmp_path / "out").objects[0]
    if repair or bridged:
        assert block.material == Dielectric(ior=1.5) and open_edges(block.mesh) == 0
        assert signed_volume(block.mesh) == pytest.approx(signed_volume(BOX), rel=1e-5)
        assert len(block.mesh.faces) <= len(mesh.faces) + (0 if bridged else len(BOX.faces) // 8 + 1)
    else:
        assert isinstance(block.material, ThinDielectric)


@pytest.mark.parametrize("bridged", [True, False])
def test_a_small_mesh_with_many_points_on_its_edges_is_solid_after_repair(bridged: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    positions, triangles = welded(BOX)
    points, faces, split = [*(0.005 * positions)], triangles.tolist(), set()
    for index in range(0, len(triangles), 2):
        a, b, c = faces[index]
        if (a, b) in split or (b, a) in split:
            continue
        split.add((a, b))
        chain = [a, *range(len(points), len(points) + 5), b]
        points += [(1 - t) * points[a] + t * points[b] for t in np.sort(rng.uniform(size=5))]
        pairs = list(itertools.pairwise(chain))
        faces[index] = [*pairs[0], c]
        faces += [[*pair, c] for pair in pairs[1:]]
        faces += [[a, end, start] for start, end in pairs[1:]] if bridged else []
    vertices, corners = np.array(points, np.float32), np.array(faces, np.int32)
    normals = vertex_normals(vertices, corners).astype(np.float32)
    mesh = Mesh(vertices=vertices, faces=corners, normals=normals, uv=np.zeros((len(vertices), 2), np.float32))
    builder = glass_of(mesh, name="bead")
    builder.node(mesh=builder.mesh(BOX, material=0), name="block", scale=[0.1] * 3, translation=[0, 0.1, 0])
    path = builder.written(tmp_path)
    answer = call(f"datagen import {path} --out {tmp_path / 'out'} --repair --scale 1")
    assert answer.status == 0, answer.err
    bead = next(item for item in load_scene(tmp_path / "out").objects if item.name == "bead")
    assert bead.material == Dielectric(ior=1.5) and open_edges(bead.mesh) == 0
    assert signed_volume(bead.mesh) == pytest.approx(0.005**3 * signed_volume(BOX), rel=1e-3)


def test_what_cannot_be_closed_is_drawn_thin_as_the_error_says(tmp_path: Path) -> None:
    fin = np.array([[*BOX.faces[0, :2], 50]], np.int32)
    finned = dataclasses.replace(BOX, faces=np.concatenate([BOX.faces, fin]))
    builder = glass_of(finned, name="block")
    path, out = builder.written(tmp_path), tmp_path / "out"
    for more in ("--repair", "--repair --material glass"):
        answer = call(f"datagen import {path} --out {out} --overwrite {more}")
        assert answer.status == 1 and "or draw it as thin glass with --material 'block=thin-glass'" in answer.error
        answer = call(f"datagen import {path} --out {out} --overwrite {more} --material 'block=thin-glass'")
        assert answer.status == 0, answer.err
        assert load_json(out / "scene.json")["objects"][0]["material"]["type"] == "ThinDielectric"  # pyright: ignore


def test_open_glass_that_was_chosen_says_what_closes_it_and_that_works(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(without(BOX, [3])), name="block")
    path = builder.written(tmp_path)
    answer = call(f"datagen import {path} --out {tmp_path / 'out'} --material glass")
    assert answer.status == 1
    assert answer.error == (
        "error: block: has 3 open edges, and glass must be closed; --repair closes holes, and --material "
        "'block=thin-glass' draws it as a thin pane"
    )
    for more in ("--repair", "--material 'block=thin-glass'"):
        assert call(f"datagen import {path} --out {tmp_path / 'out'} --overwrite --material glass {more}").status == 0


def crossed(mesh: Mesh) -> Mesh:
    """A closed body whose upper half is turned about its axis by half a turn, through itself."""
    vertices = mesh.vertices.copy()
    is_upper = vertices[:, 2] > 0
    vertices[is_upper, :2] *= -1
    vertices[is_upper, 2] -= 0.06
    return dataclasses.replace(mesh, vertices=vertices)


@pytest.mark.parametrize("is_one_object", [True, False])
def test_repair_leaves_out_the_one_body_of_many_that_crosses_itself(is_one_object: bool, tmp_path: Path) -> None:
    small = ball(0.05, subdivisions=2)
    bodies = [moved(crossed(small) if index == 17 else small, (0.2 * index, 0.0, 0.0)) for index in range(40)]
    builder = GltfBuilder()
    material = builder.material(pbrMetallicRoughness=clear(), extensions=glass())
    for index, body in enumerate([merged(bodies)] if is_one_object else bodies):
        builder.node(mesh=builder.mesh(body, material=material), name=f"bead{index}")
    command = f"datagen import {builder.written(tmp_path)} --out {tmp_path / 'out'} --scale 0.1 --up z"
    refused = call(command)
    assert refused.status == 1 and "lies inside of the rest" in refused.error
    answer = call(f"{command} --repair")
    assert answer.status == 0, answer.err
    what = (
        "bead0: of its 40 closed parts, 18 cannot be mended" if is_one_object else "bead17: left out, since it cannot"
    )
    assert what in answer.err
    beads = [item for item in load_scene(tmp_path / "out").objects if item.material.is_glass]
    assert sum(signed_volume(item.mesh) for item in beads) == pytest.approx(39e-3 * signed_volume(small), rel=1e-4)


def test_glass_that_cannot_be_mended_is_an_error_if_no_other_glass_is_in_the_file(tmp_path: Path) -> None:
    builder = glass_of(crossed(ball(0.05, subdivisions=2)), name="bead")
    builder.node(mesh=builder.mesh(BOX), name="box", translation=[0, 0, 1])
    answer = call(f"datagen import {builder.written(tmp_path)} --out {tmp_path / 'out'} --repair")
    assert answer.status == 1 and "bead" in answer.error and "crosses itself" in answer.error


@pytest.mark.parametrize("repair", ["", "--repair"])
def test_overlapping_parts_become_objects_and_keep_their_cavities(repair: str, tmp_path: Path) -> None:
    outer, inner = ball(0.1, subdivisions=3), ball(0.05, subdivisions=3)
    cavity = dataclasses.replace(inner, faces=np.ascontiguousarray(inner.faces[:, ::-1]), normals=-inner.normals)
    path = glass_of(merged([outer, cavity, moved(outer, (0.17, 0.0, 0.0))]), name="pair").written(tmp_path)
    answer = call(f"datagen import {path} --out {tmp_path / 'out'} --scale 1 {repair}")
    assert answer.status == 0, answer.err
    parts = {item.name: signed_volume(item.mesh) for item in load_scene(tmp_path / "out").objects}
    hollow = signed_volume(outer) - signed_volume(inner)
    assert [parts["pair_part0"], parts["pair_part1"]] == pytest.approx([hollow, signed_volume(outer)], rel=1e-3)
