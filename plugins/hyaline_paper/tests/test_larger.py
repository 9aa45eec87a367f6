"""Tests the table of larger pictures, and how small ones are enlarged."""

import dataclasses
from pathlib import Path

import numpy as np
from support.commands import call, run
from support.synthetic import synthetic_scene

from datagen.data.config import square
from datagen.scene.folder import save_scene
from hyaline_paper.tried import enlarge


def test_larger_pictures_have_a_table_beside_the_enlarged_small_ones(tmp_path: Path) -> None:
    scene = synthetic_scene()
    rig = dataclasses.replace(scene.cameras, azimuth_deg=(-100, 100))
    save_scene(dataclasses.replace(scene, cameras=rig), tmp_path / "scene/mine")
    size = "--preset tiny --resolution 16 --num-layers 4 --views 3 --test-views 2 --spp 2 --test-spp 2"
    run(f"datagen build '{tmp_path}/scene/mine' --out '{tmp_path}/data/mine' {size}")
    run(f"datagen add '{tmp_path}/data/mine' --larger 2 --larger-views 2")
    trained = f"'{tmp_path}/runs/mine/paper'"
    small = "--steps 3 --batch 64 --hidden 16 --texture-size 16"
    run(f"model train paper '{tmp_path}/data/mine' {small} --out {trained}")
    run(f"model predict {trained} --variant x2")
    printed = call(f"report '{tmp_path}/runs' --data '{tmp_path}/data' --table larger --format markdown").out
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in printed.splitlines() if "32 x 32" in line]
    names = [("paper", "at that size"), ("paper", "enlarged"), ("truth", "enlarged"), ("noise ceiling", "")]
    assert [tuple(row[1:3]) for row in rows] == names
    assert all(float(cell) > 0 for row in rows[:3] for cell in row[3:5])


def test_enlarging_keeps_a_ramp_where_it_was() -> None:
    """The centres of the larger picture's pixels lie at quarters between those of the smaller one's."""
    ramp = np.broadcast_to(8 * np.arange(16)[:, None, None] + 60, (16, 16, 3)).astype(np.uint8)
    large = enlarge(ramp, square(32))
    expected = 8 * ((np.arange(32) + 0.5) / 2 - 0.5) + 60
    assert np.abs(large[6:-6, 5, 1] - expected[6:-6]).max() <= 0.6
    assert np.array_equal(enlarge(ramp, square(16)), ramp)
