"""Tests the table of larger pictures, and the sheet that comes with it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.synthetic import synthetic_scene

from datagen.data.dataset import open_dataset
from datagen.data.images import read_png
from datagen.data.variants import open_variant
from datagen.scene.folder import save_scene
from eval.figures import GAP, HEADING, SIDE
from eval.page.report import make_tables


def test_larger_pictures_have_a_table_and_a_sheet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = synthetic_scene()
    rig = dataclasses.replace(scene.cameras, azimuth_deg=(-100, 100))
    save_scene(dataclasses.replace(scene, cameras=rig), tmp_path / "scene/mine")
    size = "--preset tiny --resolution 16 --num-layers 4 --views 3 --test-views 2 --spp 2 --test-spp 2"
    run(f"datagen build '{tmp_path}/scene/mine' --out '{tmp_path}/data/mine' {size}")
    run(f"datagen add '{tmp_path}/data/mine' --larger 2 --larger-views 2")
    dataset = open_dataset(tmp_path / "data/mine")
    trained = f"'{tmp_path}/runs/mine/paper'"
    run(f"model train paper '{dataset.root}' --steps 3 --batch 64 --hidden 16 --texture-size 16 --out {trained}")
    run(f"model predict {trained} --variant x2")
    make_tables(tmp_path / "runs", tmp_path / "data", tmp_path / "out", tables=["larger"], output_format="table")
    assert "mine: super-resolution, trained at 16 x 16" in capsys.readouterr().out
    # Rows and columns of pixels are ten times enlarged.
    sheet = read_png(tmp_path / "out/larger_mine.png")
    truth = open_variant(dataset, "x2").view("interpolating", 0).image
    drawn = read_png(tmp_path / "runs/mine/paper/variants/x2/predictions/interpolating/0000.png")
    for left, picture in ((SIDE, truth), (SIDE + 320 + GAP, drawn)):
        panel = sheet[HEADING : HEADING + 320, left : left + 320]
        np.testing.assert_array_equal(panel[5::10, 5::10], picture)
