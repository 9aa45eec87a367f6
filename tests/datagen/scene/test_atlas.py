import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.meshes import chart_map, gutter_violations, mesh_of

from datagen.data.meshes import Mesh, face_corners
from datagen.data.ply import write_ply
from datagen.disk.errors import HyalineError
from datagen.scene.atlas import bake_positions, coverage, unwrap, unwrap_all
from datagen.scene.modelling import ball, merged, moved, rounded_box, sheet

SHAPES = {
    "box": rounded_box((0.4, 0.3, 0.2), bevel=0.02, segments=1),
    "ball": ball(2.0, subdivisions=3),
    "knotted": mesh_of(trimesh.creation.torus(1.0, 0.3, major_sections=24, minor_sections=12)),
    "two": merged([ball(0.1, subdivisions=2), sheet((5, 5, 5), (3, 0, 0), (0, 2, 0), cells=(3, 2))]),
}


@pytest.fixture(scope="module")
def unwrapped() -> dict[str, Mesh]:
    """Shapes of several kinds, one of them of two parts, unwrapped by one child."""
    return unwrap_all(SHAPES)


@pytest.mark.parametrize("kind", SHAPES)
def test_an_atlas_keeps_the_surface_and_neither_overlaps_nor_touches(unwrapped: dict[str, Mesh], kind: str) -> None:
    mesh, source = unwrapped[kind], SHAPES[kind]
    np.testing.assert_array_equal(face_corners(mesh), face_corners(source))
    np.testing.assert_array_equal(mesh.normals[mesh.faces], source.normals[source.faces])
    a, b, c = np.moveaxis(mesh.uv[mesh.faces].astype(np.float64), 1, 0)
    areas = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert areas.min() > 1e-9
    assert mesh.uv.min() >= 0 and mesh.uv.max() <= 1
    counts = coverage(mesh, 1024)
    assert counts.max() == 1 and (counts > 0).mean() > 0.3
    assert chart_map(mesh, 256).max() >= 1
    assert gutter_violations(mesh, 256) == 0


def test_the_same_mesh_gives_the_same_bytes_alone_and_in_company(unwrapped: dict[str, Mesh]) -> None:
    alone = unwrap(ball(2.0, subdivisions=3), where="ball")
    for name in ("vertices", "faces", "normals", "uv"):
        assert getattr(alone, name).tobytes() == getattr(unwrapped["ball"], name).tobytes()


def test_atlas_does_not_depend_on_the_scale() -> None:
    tiny = unwrap(ball(2.0**-20, subdivisions=2), where="tiny")
    huge = unwrap(ball(2.0**13, subdivisions=2), where="huge")
    np.testing.assert_array_equal(tiny.uv, huge.uv)
    assert coverage(tiny, 512).max() == 1


def test_baked_positions_lie_on_the_surface_everywhere_even_in_gutters(unwrapped: dict[str, Mesh]) -> None:
    radius = np.linalg.norm(bake_positions(unwrapped["ball"], 128), axis=-1)
    chord = 2.0 * np.cos(0.1)  # The faces of the geodesic ball dip under the sphere by up to half an edge's angle.
    assert radius.max() <= 2.0 + 1e-5
    assert radius.min() >= chord


def test_baked_positions_agree_with_a_loop_over_triangles(unwrapped: dict[str, Mesh]) -> None:
    mesh, size = unwrapped["box"], 24
    baked = bake_positions(mesh, size)
    covered = 0
    for row in range(size):
        for column in range(size):
            point = np.array([(column + 0.5) / size, 1 - (row + 0.5) / size])
            for face in mesh.faces:
                matrix = np.concatenate([mesh.uv[face].astype(np.float64).T, np.ones((1, 3))])
                weights = np.linalg.solve(matrix, [*point, 1.0])
                if weights.min() > 1e-6:
                    np.testing.assert_allclose(baked[row, column], weights @ mesh.vertices[face], atol=1e-5)
                    covered += 1
    assert abs(covered - int(coverage(mesh, size).sum())) <= 1  # One may lie on an edge but for rounding.
    assert covered > 200


def test_a_chart_thinner_than_a_texel_still_has_its_position() -> None:
    mesh = unwrap(
        merged([sheet((0, 0, 0), (1, 0, 0), (0, 1, 0)), sheet((0, 0, 5), (1e-3, 0, 0), (0, 1e-3, 0))]), where="x"
    )
    assert (bake_positions(mesh, 64)[..., 2] == 5).any()


SHEET = sheet((0, 0, 0), (1, 0, 0), (0, 1, 0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": SHEET.vertices + np.float32(np.inf)}, "finite numbers"),
        ({"normals": SHEET.normals * np.float32(np.nan)}, "normals are not finite"),
    ],
)
def test_what_hangs_xatlas_is_refused(change: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(HyalineError, match=f"chair: .*({message})"):
        unwrap(dataclasses.replace(SHEET, **change), where="chair")


def test_copies_of_a_surface_share_one_atlas_that_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    # Powers of two, so that it is the same surface but for its place.
    whole = dataclasses.replace(SHAPES["box"], vertices=np.rint(SHAPES["box"].vertices * 1024) / np.float32(1024))
    found = unwrap_all({str(index): moved(whole, (index, 0, 0)) for index in range(3)})
    for index in range(3):
        np.testing.assert_array_equal(found[str(index)].vertices, found["0"].vertices + np.float32([index, 0, 0]))
        np.testing.assert_array_equal(found[str(index)].uv, found["0"].uv)
    (kept,) = (tmp_path / "hyaline" / "atlases").iterdir()
    kept.write_bytes(b"no archive")
    assert write_ply(unwrap(whole, where="box")) == write_ply(found["0"])
