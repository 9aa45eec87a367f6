"""Tests that holes in glass are closed, that the volume is kept or the file refused, and that both are said."""

import dataclasses
import itertools
import warnings
from pathlib import Path

import numpy as np
import pytest
from support.foreign import add, glass_entry, taken
from support.gltf import BOX, glass_of

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
from datagen.scene.finding import ImportChoices
from datagen.scene.materials import Dielectric, ThinDielectric
from datagen.scene.modelling import ball, merged, moved
from hyaline_import.importing import import_scene
from hyaline_import.remarks import Remarks
from hyaline_import.surfaces import closed

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
    with pytest.raises(HyalineError, match="leave out --strict"):
        import_scene(path, ImportChoices(repair=True, strict=True))


def with_split_edges(mesh: Mesh, *, bridged: bool, every: int = 8, points: int = 1, scale: float = 1.0) -> Mesh:
    """The mesh with some of its edges split on one side only, so that points lie on a neighbour's edge.

    Args:
        bridged: faces without area close each of these cracks.
        every: one face in that many is split, at so many random points of an edge.
    """
    rng = np.random.default_rng(0)
    positions, triangles = welded(mesh)
    found, faces, split = [*(scale * positions)], triangles.tolist(), set()
    for index in range(0, len(triangles), every):
        a, b, c = faces[index]
        if frozenset((a, b)) in split:
            continue
        split.add(frozenset((a, b)))
        chain = [a, *range(len(found), len(found) + points), b]
        shares = np.sort(rng.uniform(size=points)) if points > 1 else [0.5]
        found += [(1 - t) * found[a] + t * found[b] for t in shares]
        pairs = list(itertools.pairwise(chain))
        faces[index] = [*pairs[0], c]
        faces += [[*pair, c] for pair in pairs[1:]]
        faces += [[a, end, start] for start, end in pairs[1:]] if bridged else []
    vertices, corners = np.array(found, np.float32), np.array(faces, np.int32)
    normals = vertex_normals(vertices, corners).astype(np.float32)
    return Mesh(vertices=vertices, faces=corners, normals=normals, uv=np.zeros((len(vertices), 2), np.float32))


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
    cavity = dataclasses.replace(inner, faces=np.ascontiguousarray(inner.faces[:, ::-1]), normals=-inner.normals)
    path = glass_of(merged([outer, cavity, moved(outer, (0.17, 0.0, 0.0))]), name="pair").written(tmp_path)
    done = taken(path, f"--scale 1 {repair}")
    hollow = signed_volume(outer) - signed_volume(inner)
    volumes = [signed_volume(done[name].mesh) for name in ("pair_part0", "pair_part1")]
    assert volumes == pytest.approx([hollow, signed_volume(outer)], rel=1e-3)
