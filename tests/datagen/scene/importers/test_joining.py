"""Tests that overlapping parts become the solid that they fill, by closed formulas, or are refused."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.commands import call
from support.gltf import glass_of

from datagen.data.meshes import Mesh, check_closed, check_solid, open_edges, signed_volume
from datagen.disk.errors import HyalineError
from datagen.disk.records import load_json
from datagen.scene.importers import overlaps
from datagen.scene.importers.overlaps import filled_volume, joined
from datagen.scene.modelling import ball, merged, moved
from datagen.scene.remarks import Remarks

BALL = ball(0.1, subdivisions=3)


def turned_in(mesh: Mesh) -> Mesh:
    return dataclasses.replace(mesh, faces=np.ascontiguousarray(mesh.faces[:, ::-1]), normals=-mesh.normals)


def lens(radius: float, distance: float) -> float:
    """Volume that two balls share."""
    return math.pi * (4 * radius + distance) * (2 * radius - distance) ** 2 / 12


@pytest.mark.parametrize("distance", [0.03, 0.1, 0.17])
def test_two_balls_become_their_union(distance: float) -> None:
    remarks = Remarks()
    pair = merged([BALL, moved(BALL, (distance, 0.01 * distance, 0.0))])
    whole = joined(pair, remarks, where="pair")
    check_closed(whole, where="pair")
    check_solid(whole, where="pair")
    fine = 8 / 3 * math.pi * 0.1**3 - lens(0.1, distance)
    shrunk = signed_volume(BALL) / (4 / 3 * math.pi * 0.1**3)  # A ball of faces is smaller than a round one.
    assert signed_volume(whole) == pytest.approx(shrunk * fine, rel=2e-3)
    np.testing.assert_allclose(np.linalg.norm(whole.normals, axis=-1), 1, atol=1e-5)
    (line,) = remarks.lines
    assert line.is_approximation and line.what.startswith("2 overlapping parts joined: the space that they fill was ")
    assert line.what.endswith(f"and is {1e6 * signed_volume(whole):.4g} cm^3")


def test_the_space_that_parts_fill_is_measured_to_a_percent() -> None:
    pair = merged([BALL, moved(BALL, (0.05, 0.0, 0.0))])
    assert filled_volume(BALL) == pytest.approx(signed_volume(BALL), rel=0.01)
    assert filled_volume(pair) == pytest.approx(8 / 3 * math.pi * 0.1**3 - lens(0.1, 0.05), rel=0.02)


def test_bars_through_each_other_count_their_crossing_once() -> None:
    bars = [trimesh.creation.box(extents) for extents in ((0.3, 0.1, 0.1), (0.1, 0.3, 0.1), (0.1, 0.1, 0.3))]
    meshes = []
    for bar in bars:
        corners = np.asarray(bar.vertices[bar.faces].reshape(-1, 3), np.float32)
        meshes.append(
            Mesh(
                vertices=corners,
                faces=np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
                normals=np.zeros_like(corners),
                uv=np.zeros((len(corners), 2), np.float32),
            )
        )
    whole = joined(merged(meshes), Remarks(), where="cross")
    assert signed_volume(whole) == pytest.approx(7 * 0.1**3, rel=1e-4)
    assert open_edges(whole) == 0


def test_a_cavity_stays_in_its_part() -> None:
    hollow = merged([BALL, turned_in(ball(0.05, subdivisions=2))])
    whole = joined(merged([hollow, moved(BALL, (0.16, 0.0, 0.0))]), Remarks(), where="pair")
    check_solid(whole, where="pair")
    outer = joined(merged([BALL, moved(BALL, (0.16, 0.0, 0.0))]), Remarks(), where="pair")
    cavity = signed_volume(ball(0.05, subdivisions=2))
    assert signed_volume(whole) == pytest.approx(signed_volume(outer) - cavity, rel=1e-4)


def test_parts_that_do_not_overlap_stay_to_the_last_bit() -> None:
    remarks = Remarks()
    pair = merged([BALL, moved(BALL, (0.3, 0.0, 0.0))])
    assert joined(pair, remarks, where="pair") is pair
    assert joined(BALL, remarks, where="ball") is BALL
    assert remarks.lines == []


def test_a_surface_that_crosses_itself_is_refused() -> None:
    crossed = dataclasses.replace(BALL, vertices=BALL.vertices * np.float32([1, 1, 1]))
    crossed.vertices[np.abs(crossed.vertices[:, 2] - crossed.vertices[:, 2].max()) < 1e-6, 2] = -0.3  # Through itself.
    with pytest.raises(HyalineError, match="ball: its parts overlap, and cannot be joined, since its surface crosses"):
        joined(crossed, Remarks(), where="ball")


def test_a_change_of_the_volume_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(overlaps, "filled_volume", lambda mesh: 1.07 * signed_volume(mesh) / 2)
    pair = merged([BALL, moved(BALL, (0.05, 0.0, 0.0))])
    with pytest.raises(HyalineError, match=r"2 overlapping parts joined: .* % off; expected at most 5 %"):
        joined(pair, Remarks(), where="pair")


def test_repair_joins_the_overlapping_glass_of_a_file_and_import_json_says_the_volumes(tmp_path: Path) -> None:
    pair = merged([BALL, moved(BALL, (0.09, 0.0, 0.0))])
    builder = glass_of(pair, name="pair")
    path = builder.written(tmp_path)
    answer = call(f"datagen import {path} --out {tmp_path / 'apart'}")
    assert "each became an object of its own" in answer.err
    call(f"datagen import {path} --repair --out {tmp_path / 'one'}")
    record = load_json(tmp_path / "one" / "import.json")
    assert any("2 overlapping parts joined" in line for line in record["approximations"])
    names = [item["name"] for item in load_json(tmp_path / "one" / "scene.json")["objects"]]
    assert names == ["pair", "ground"]
