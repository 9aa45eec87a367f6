"""Tests that a trained renderer draws an edited scene: what is removed from the geometry vanishes from the picture."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from support.commands import call
from support.meshes import mesh_of
from support.synthetic import quad, synthetic_scene

from datagen.builder.build import build_dataset
from datagen.builder.variants import build_variant, plan_edit
from datagen.data.config import TEST_SPLITS, DatasetConfig, Split, SplitConfig, square
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.images import png_bytes, read_png
from datagen.data.paths import TRUTH
from datagen.data.variants import ELSEWHERE, LIGHT, OBJECT, open_variant, read_edit_mask
from datagen.disk.records import SEAL, commit_sealed, load_sealed, seal_of
from datagen.disk.storage import sha256
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import Scene, SceneObject, SoftEnvironment
from datagen.scene.edits import parse_edit
from datagen.scene.materials import Dielectric, Diffuse, SolidTexture
from eval.page.report import make_report
from model.methods.light_path.config import LightPathConfig
from model.methods.paper.config import PaperConfig
from model.nets.texture import NeuralTextures, object_layout
from model.run.predict import render_predictions, render_variant, with_copies
from model.run.run_folder import TrainConfig, is_drawn, read_predictions, write_predictions
from model.run.train import train

use_mitsuba()

GLASS = Dielectric(ior=1.5, absorption=(0.2, 0.6, 1.5))
CHECKER = Diffuse(color=SolidTexture(pattern="checker", colors=((0.7, 0.6, 0.2), (0.1, 0.2, 0.5)), scale=0.5))
LIGHT_PATH = TrainConfig(
    method="light-path",
    geometry=TRUTH,
    steps=90,
    batch=512,
    lr=0.002,
    texture_lr=0.02,
    lr_decay="cosine",
    net=LightPathConfig(texture_sizes=(8, 64), texture_levels=2, branches=6, render_samples=9),
    evaluate_every=90,
)
PAPER = TrainConfig(
    method="paper",
    geometry=TRUTH,
    steps=3,
    batch=512,
    evaluate_every=90,
    net=PaperConfig(width=16, texture_size=16, position_size=32, zero_layer=True),
)
EDITS = ("remove:ball", "duplicate:ball:0.3,0.8,0")
SPLIT: Split = "interpolating"


def scene() -> Scene:
    """A ball of tinted glass over a chequered floor."""
    ball = mesh_of(trimesh.creation.icosphere(3, 0.4).apply_translation((0.0, 0.0, 0.45)))
    return dataclasses.replace(
        synthetic_scene(),
        objects=(
            SceneObject(name="ball", mesh=ball, material=GLASS),
            SceneObject(name="floor", mesh=quad(0.0), material=CHECKER),
        ),
        environment=SoftEnvironment(zenith=(0.9, 0.9, 0.9), horizon=(0.8, 0.7, 0.6), ground=(0.3, 0.3, 0.3)),
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, two edits of it, and two runs that drew them all."""
    root = tmp_path_factory.mktemp("edits")
    few = SplitConfig(views=2, spp=64)
    config = DatasetConfig(
        scene="edit",
        preset="tiny",
        resolution=square(32),
        train=SplitConfig(views=12, spp=32),
        interpolating=few,
        extrapolating=few,
    )
    base = build_dataset(scene(), root / "data" / "edit", config, num_layers=4, workers=1, overwrite=False)
    edits = [build_variant(base, plan_edit(base, (parse_edit(text),)), workers=1) for text in EDITS]
    for name, run in (("ours", LIGHT_PATH), ("paper", PAPER)):
        out = root / "runs" / "edit" / name
        train(run, base, out, label=name, device=torch.device("cpu"))
        render_predictions(out, run, base, device=torch.device("cpu"))
        for edited in edits:
            render_variant(out, run, base, edited, device=torch.device("cpu"))
    return root


def datasets(root: Path) -> tuple[Dataset, Dataset, Dataset]:
    """The base, without the ball, with two balls."""
    base = open_dataset(root / "data" / "edit")
    return base, open_variant(base, "remove-ball"), open_variant(base, "duplicate-ball-0.3,0.8,0")


def psnr(pred: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    error = (pred[mask].astype(np.float64) - truth[mask]) / 255
    return float(-10 * np.log10(np.square(error).mean()))


def test_a_removed_ball_of_glass_leaves_the_floor_that_was_behind_it(made: Path) -> None:
    base, after, _ = datasets(made)
    run = made / "runs" / "edit" / "ours"
    kept = read_png(run / "predictions" / SPLIT / "0000.png")
    edited = read_png(run / "variants" / "remove-ball" / "predictions" / SPLIT / "0000.png")
    in_ball = base.view(SPLIT, 0).layers().object_id[0] == 1
    assert 0.05 < in_ball.mean() < 0.5
    assert np.array_equal(read_edit_mask(after, SPLIT, 0) == OBJECT, in_ball)
    truth_before, truth_after = (dataset.view(SPLIT, 0).image for dataset in (base, after))
    assert psnr(kept, truth_before, in_ball) > 24
    assert psnr(edited, truth_after, in_ball) > 24
    # The edit is seen: neither picture would pass for the other.
    assert psnr(kept, truth_after, in_ball) < 18
    assert psnr(edited, truth_before, in_ball) < 18


def test_a_copy_of_the_ball_refracts_the_floor_behind_it(made: Path) -> None:
    base, _, after = datasets(made)
    assert 3 in after.view(SPLIT, 0).layers().object_id
    in_copy = read_edit_mask(after, SPLIT, 0) == OBJECT
    edited = read_png(made / "runs" / "edit" / "ours" / "variants" / after.name / "predictions" / SPLIT / "0000.png")
    assert psnr(edited, after.view(SPLIT, 0).image, in_copy) > 20
    assert psnr(base.view(SPLIT, 0).image, after.view(SPLIT, 0).image, in_copy) < 18


def test_predictions_of_another_version_of_an_edit_count_as_none(made: Path) -> None:
    _, after, _ = datasets(made)
    run = made / "runs" / "edit" / "ours"
    assert is_drawn(run, after)
    assert not is_drawn(run, dataclasses.replace(after, seal="another"))
    assert not is_drawn(made / "runs" / "edit", after)


def test_the_commands_edit_and_draw_what_is_there(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(made)
    data = call("datagen add edit --edit remove:ball")
    assert data.out == "data/edit/variants/remove-ball\n"
    assert data.err.splitlines()[-1] == "next: model predict runs/edit/ours --variant remove-ball"
    run = "model predict runs/edit/paper --dataset edit --variant"
    picture = made / "runs" / "edit" / "paper" / "variants" / "remove-ball" / "predictions" / SPLIT / "0001.png"
    drawn = picture.read_bytes()
    picture.unlink()
    # A picture of an earlier version of the variant, which had more views.
    folder = picture.parents[2]
    files = read_predictions(folder) | {f"predictions/{SPLIT}/0007.png": sha256(drawn)}
    picture.with_name("0007.png").write_bytes(drawn)
    write_predictions(folder.parents[1], datasets(made)[1], files)
    assert call(f"{run} remove:ball").out == "runs/edit/paper/variants/remove-ball\n"
    assert picture.read_bytes() == drawn and not picture.with_name("0007.png").exists()


def test_the_report_scores_edits_by_region(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_report(made / "runs", made / "data", made / "out", output_format="markdown")
    assert "### edit, after remove:ball" in capsys.readouterr().out
    results = json.loads((made / "out" / "results.json").read_text())
    _, after, _ = datasets(made)

    # Regions, by a slow loop over pixels.
    scored = {tuple(edit["edits"]): edit for edit in results["scenes"][0]["analyses"]["variants"].values()}
    rows = scored[("remove:ball",)]["regions_psnr_db"]
    assert set(rows) == {"ours", "paper", "truth before the edit"}
    place = made / "runs" / "edit" / "ours" / "variants" / "remove-ball"
    for split in TEST_SPLITS:
        for region, value in (("object", OBJECT), ("light", LIGHT), ("elsewhere", ELSEWHERE)):
            values = []
            for view in range(2):
                mask = read_edit_mask(after, split, view) == value
                pred = read_png(place / "predictions" / split / f"000{view}.png")
                if mask.any():
                    values.append(psnr(pred, after.view(split, view).image, mask))
            assert rows["ours"][region][split] == pytest.approx(np.mean(values))
    assert rows["truth before the edit"]["object"][SPLIT] < rows["ours"]["object"][SPLIT] - 5
    assert "truth after, " in (made / "out" / "index.html").read_text()


def test_seeds_share_a_row_in_the_tables_of_edits(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second seed of `paper` draws everything black."""
    shutil.copytree(made / "runs", tmp_path / "runs")
    black = tmp_path / "runs" / "edit" / "paper-seed1"
    shutil.copytree(black.with_name("paper"), black)
    record = json.loads((black / "run.json").read_text())
    record["seed"] = record["config"]["seed"] = 1
    del record[SEAL]
    commit_sealed(black / "run.json", record)
    for path in black.rglob("predictions.json"):
        listed = load_sealed(path)
        listed["run_seal"] = seal_of(record)
        for picture in listed["files"]:
            black_png = png_bytes(np.zeros_like(read_png(path.parent / picture)))
            (path.parent / picture).write_bytes(black_png)
            listed["files"][picture] = sha256(black_png)
        commit_sealed(path, listed)
    make_report(tmp_path / "runs", made / "data", tmp_path / "out", output_format="markdown")

    results = json.loads((tmp_path / "out" / "results.json").read_text())["scenes"][0]["analyses"]
    of_run = {
        run: regions["object"][SPLIT] for run, regions in results["variants"]["remove-ball"]["regions_psnr_db"].items()
    }
    table = capsys.readouterr().out.split("### edit, after remove:ball")[1].split("###")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if line.startswith("| ")]
    (row,) = (row for row in rows if row[:2] == ["paper", "2"])
    assert row[2 + TEST_SPLITS.index(SPLIT)] == f"{(of_run['paper'] + of_run['paper-seed1']) / 2:.2f}"
    assert of_run["paper"] > of_run["paper-seed1"] + 5
    assert [row[1] for row in rows if row[0] == "ours"] == ["1"] and "paper-seed1" not in table


def test_a_copy_looks_up_the_texels_of_its_original() -> None:
    textures = NeuralTextures(object_layout((4, 8, 2)), 3)
    torch.nn.init.normal_(textures.table)
    textures.layout = with_copies(textures.layout, [1, 1], 3)
    uv = torch.rand(50, 1, 2)
    ids = torch.full((50, 1), 2, dtype=torch.uint8)
    for copy in (4, 5):
        assert torch.equal(textures(uv, torch.full_like(ids, copy)), textures(uv, ids))
    assert not torch.equal(textures(uv, torch.full_like(ids, 1)), textures(uv, ids))
