"""Tests the mesh record, its checks and its PLY file."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.meshes import mesh_of
from trimesh.visual.texture import TextureVisuals

from datagen.data.meshes import Mesh, check_mesh, open_edges, signed_volume, unfolded
from datagen.data.ply import read_ply, write_ply
from datagen.data.queries import check_closed
from datagen.disk.errors import HyalineError

BALL = mesh_of(trimesh.creation.icosphere(2))


def test_our_ply_files_are_those_of_trimesh_and_are_read_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exported = trimesh.Trimesh(BALL.vertices, BALL.faces, vertex_normals=BALL.normals, process=False)
    exported.visual = TextureVisuals(uv=BALL.uv)
    assert write_ply(BALL) == exported.export(file_type="ply", encoding="binary", vertex_normal=True)
    path = tmp_path / "ball.ply"
    path.write_bytes(write_ply(BALL).replace(b"comment https", b"comment made of https"))
    by_trimesh, _ = read_ply(path)
    path.write_bytes(write_ply(BALL))
    monkeypatch.setitem(sys.modules, "trimesh", None)
    ours, _ = read_ply(path)
    for field in dataclasses.fields(Mesh):
        mine, theirs = getattr(ours, field.name), getattr(by_trimesh, field.name)
        assert mine.dtype == theirs.dtype and np.array_equal(mine, theirs), field.name
    path.write_bytes(write_ply(dataclasses.replace(BALL, faces=BALL.faces + 100)))
    with pytest.raises(HyalineError, match=r"ball\.ply: a face names vertex 261; expected 0 to 161"):
        read_ply(path)


def test_every_truncation_of_a_ply_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "ball.ply"
    for data in (write_ply(BALL), trimesh.creation.box().export(file_type="ply", encoding="ascii")):
        for end in range(0, len(data) - 1, max(1, len(data) // 60)):
            path.write_bytes(data[:end])
            with pytest.raises(HyalineError, match=r"ball\.ply"):
                read_ply(path)


@pytest.mark.parametrize("seed", range(4))
def test_polygons_of_any_shape_are_covered_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    positions, faces, area = [], [], 0.0
    sizes = rng.integers(3, 12, 20)
    for size in sizes:
        angle = np.arange(size) * 2 * np.pi / size
        x, y = rng.uniform(0.1, 1, size) * [np.cos(angle), np.sin(angle)]
        area += (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
        first = sum(map(len, positions))
        positions.append(np.stack([x, y, 0 * x], axis=-1) @ turn.T + rng.normal(size=3))
        faces += [(first, first + corner, first + corner + 1) for corner in range(1, size - 1)]
    found = unfolded(np.concatenate(positions), np.array(faces), sizes - 2)
    a, b, c = np.moveaxis(np.concatenate(positions)[found], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum() / 2 == pytest.approx(area)
    own = np.repeat(np.arange(20), sizes)[found]
    assert (own == np.repeat(np.arange(20), sizes - 2)[:, None]).all()


def test_volume_and_openness_of_known_shapes() -> None:
    box = mesh_of(trimesh.creation.box((1, 2, 3)))
    assert signed_volume(box) == pytest.approx(6)
    assert open_edges(box) == 0
    reversed_box = dataclasses.replace(box, faces=box.faces[:, ::-1])
    assert signed_volume(reversed_box) == pytest.approx(-6)
    assert open_edges(dataclasses.replace(box, faces=box.faces[1:])) == 3


def broken(**changes: object) -> Mesh:
    return dataclasses.replace(BALL, **changes)


def with_value(values: np.ndarray, value: float) -> np.ndarray:
    changed = values.copy()
    changed[7, 0] = value
    return changed


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (broken(vertices=with_value(BALL.vertices, np.nan)), r"vertices\[7\] is \[nan"),
        (broken(vertices=with_value(BALL.vertices, 1e7)), r"a coordinate is 1e\+07 m"),
        (broken(faces=with_value(BALL.faces, 1_000_000)), r"a face names vertex 1000000; expected 0 to 161"),
        (broken(faces=with_value(BALL.faces, -5)), r"a face names vertex -5"),
        (broken(faces=np.tile(BALL.faces[:1, :1], (1, 3))), r"face 0 has no area"),
        (broken(faces=BALL.faces[:0]), r"0 faces; expected at least one"),
        (broken(uv=with_value(BALL.uv, np.inf)), r"uv\[7\] is \[inf"),
        (broken(uv=with_value(BALL.uv, 7.0)), r"uv spans .* to 7; expected \[0, 1\]"),
    ],
)
def test_a_bad_mesh_is_refused_before_a_native_library_sees_it(mesh: Mesh, message: str) -> None:
    with pytest.raises(HyalineError, match=rf"^vase: .*{message}"):
        check_mesh(mesh, where="vase")


def test_open_glass_and_an_inverted_part_are_refused_and_a_cavity_is_not() -> None:
    with pytest.raises(HyalineError, match="3 open edges"):
        check_closed(broken(faces=BALL.faces[1:]), where="vase")
    ball, small = trimesh.creation.icosphere(2, 1.0), trimesh.creation.icosphere(2, 0.4)
    small.invert()
    bubble = mesh_of(trimesh.util.concatenate([ball, small]))
    check_closed(bubble, where="bubble")
    beside = mesh_of(trimesh.util.concatenate([ball, small.copy().apply_translation((3, 0, 0))]))
    assert signed_volume(beside) > 0  # Looking at the whole would not tell.
    with pytest.raises(HyalineError, match=r"part 2 of 2 encloses -0\.2\d* m\^3, so it is inside out"):
        check_closed(beside, where="balls")
