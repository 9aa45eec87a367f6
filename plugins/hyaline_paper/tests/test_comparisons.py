"""Tests of seeds, the paper's tables and the claims, on errors of known size."""

import dataclasses
import json
import math
import statistics
from pathlib import Path

import numpy as np
import pytest
from support.commands import call, run
from support.synthetic import synthetic_scene, write_synthetic_dataset

from datagen.data.config import TEST_SPLITS, Split, square
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.images import png_bytes, read_png
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.disk.records import to_json
from datagen.scene.folder import save_scene
from eval.page.report import make_report, make_tables
from eval.score.runs import open_run
from eval.score.scores import SceneScores, Truth, read_truth, score_run
from eval.tables.grids import MISSING
from hyaline_paper import claims
from hyaline_paper.tried import enlarge
from model.methods.paper.config import PaperBestConfig, PaperConfig
from model.run.run_folder import TrainConfig
from model.run.train_flags import Asked, flags_asked
from model.settings import LossConfig, RunFlags

PAPER = TrainConfig(method="paper", geometry="truth", net=PaperConfig(width=80, texture_size=64))
BEST = dataclasses.replace(
    PAPER,
    method="paper-best",
    net=dataclasses.replace(PaperBestConfig().usual(TRUTH), width=128, texture_size=128),
    loss=LossConfig(softness=0.03),
)


def decibels(level: int) -> float:
    return 20 * math.log10(255 / level)


def wrapped(level: int) -> float:
    return 10 * math.log10(255**2 / (level**2 % 256))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(
        tmp_path_factory.mktemp("tables") / "data" / "synthetic", resolution=8, train_views=1
    )


def write_run(
    dataset: Dataset, runs: Path, name: str, config: TrainConfig | str, near: int, far: int, *, geometry: str = "truth"
) -> None:
    """A run all of whose pixels are off by so many levels of 255; a method's name instead of a configuration."""
    folder = runs / "synthetic" / name
    for split, level in zip(TEST_SPLITS, (near, far), strict=True):
        (folder / "predictions" / split).mkdir(parents=True)
        for view in range(2):
            truth = dataset.view(split, view).image
            off = np.where(truth < 128, truth + np.uint8(level), truth - np.uint8(level))
            (folder / "predictions" / split / f"{view:04d}.png").write_bytes(png_bytes(off))
    record: dict[str, object] = {"dataset": dataset.root.as_posix(), "dataset_seal": dataset.seal}
    if isinstance(config, str):
        record |= {"method": config, "geometry": geometry}
    else:
        record |= {
            "method": config.method,
            "geometry": config.geometry,
            "seed": config.seed,
            "config": to_json(config),
            "flags": flags_of(config),
            "layers_seal": "the same",
            "num_parameters": 34483,
        }
    (folder / "run.json").write_text(json.dumps(record))


def flags_of(config: TrainConfig) -> dict[str, str]:
    """As `model train` records them, of choices that decide which table a run stands in."""
    net = config.net
    usual = net.usual(config.geometry)
    fitted = {"width", "texture_size", "texture_sizes", "shells", "refined_samples"} & {
        item.name for item in dataclasses.fields(usual)
    }
    chosen = dataclasses.replace(net, **{name: getattr(usual, name) for name in fitted})
    asked = Asked(
        dataset=None,
        run=RunFlags(geometry=config.geometry, seed=config.seed),
        method=chosen,
        optimisation=dataclasses.replace(usual.optimisation(), steps=config.steps, loss=config.loss),
    )
    return flags_asked(asked)


def paper(*, seed: int = 0, geometry: str = "truth", steps: int = 2500, **net: object) -> TrainConfig:
    return dataclasses.replace(
        PAPER, seed=seed, geometry=geometry, steps=steps, net=dataclasses.replace(PAPER.net, **net)
    )


def tables(dataset: Dataset, runs: Path, *names: str, output_format: str = "markdown") -> None:
    make_tables(runs, dataset.root.parent, tables=names, output_format=output_format)


def rows_of(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if "---" not in line]


# Seeds


def test_the_report_averages_runs_that_differ_in_their_seed_alone(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed, level in enumerate((5, 7, 10)):
        write_run(dataset, tmp_path, f"paper-seed{seed}" if seed else "paper", paper(seed=seed), level, 20)
    write_run(dataset, tmp_path, "paper-100-steps-seed1", paper(seed=1, steps=100), 30, 30)
    write_run(dataset, tmp_path, "again", paper(seed=1, steps=100), 31, 31)  # The same seed: no spread to be had.
    make_report(tmp_path, dataset.root.parent, tmp_path / "report", output_format="markdown")
    rows = {row[0]: row[1:] for row in rows_of(capsys.readouterr().out)}
    expected = [decibels(level) for level in (5, 7, 10)]
    mean = f"**{statistics.fmean(expected):.2f} ± {statistics.stdev(expected):.2f}**"
    assert rows["paper"][:3] == ["3", mean, f"**{decibels(20):.2f} ± 0.00**"]
    assert rows["again"][:2] == ["1", f"{decibels(31):.2f}"] and "paper-seed1" not in rows

    make_report(tmp_path, dataset.root.parent, tmp_path / "report", output_format="json")
    (scene,) = json.loads(capsys.readouterr().out)["scenes"]
    (group,) = scene["seeds"]
    assert group["runs"] == ["paper", "paper-seed1", "paper-seed2"]
    assert group["scores"]["psnr_db_interpolating"]["deviation"] == pytest.approx(statistics.stdev(expected))
    hashes = {run["run"]: run["config_sha256"] for run in scene["runs"]}
    assert hashes["paper"] == hashes["paper-seed2"] == group["config_sha256"] != hashes["again"]


# The paper's tables


def test_table_1_sets_comparable_runs_beside_the_papers_numbers(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed, level in enumerate((17, 20)):
        write_run(dataset, tmp_path, f"view{seed}", paper(seed=seed), level, 25)
    write_run(dataset, tmp_path, "harmonics", paper(extrinsics="sh", width=72), 18, 30)
    write_run(dataset, tmp_path, "short", paper(steps=100), 90, 90)  # Nothing to compare it with.
    write_run(dataset, tmp_path, "zero", paper(zero_layer=True), 90, 90)  # Not the paper's table.
    write_run(
        dataset, tmp_path, "random-vgg", dataclasses.replace(paper(), loss=LossConfig(vgg_weights="random")), 5, 5
    )
    tables(dataset, tmp_path, "table1")
    text = capsys.readouterr().out
    rows = {row[0]: row[1:] for row in rows_of(text)[1:]}
    near = [decibels(17), decibels(20)]
    cell = f"{statistics.fmean(near):.2f}±{statistics.stdev(near):.2f}"
    assert rows["view vector (L1 alone)"][1:4] == ["2", cell, f"{decibels(25):.2f}±0.00"]
    assert rows["spherical harmonics (L1 alone)"] == [
        "harmonics",
        "1",
        f"{decibels(18):.2f}",
        f"{decibels(30):.2f}",
        f"{decibels(18) - decibels(30):.2f}",
        f"{wrapped(18):.2f}",
        f"{wrapped(30):.2f}",
        MISSING,
        "33.80",
        "32.52",
    ]
    assert rows["no extrinsics"][0] == "not run" and rows["no extrinsics"][-2:] == ["33.09", "32.96"]
    assert len(rows) == 3


def test_methods_are_told_by_their_records_whoever_made_them(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(dataset, tmp_path, "somebodys", "dnr", 5, 40)
    write_run(dataset, tmp_path, "wide", "mlp-first", 12, 13)
    write_run(dataset, tmp_path, "ours", paper(), 10, 12)
    write_run(dataset, tmp_path, "stand-in", dataclasses.replace(paper(), loss=LossConfig(vgg_weights="random")), 11, 9)
    write_run(dataset, tmp_path, "voxels", "deepvoxels", 30, 35, geometry="none")
    write_run(dataset, tmp_path, "boxes", "dnr", 20, 20, geometry="box")
    tables(dataset, tmp_path, "square", "table2")
    rows = rows_of(capsys.readouterr().out)
    assert [row[:2] for row in rows if row[0]] == [
        ["U-Net, first layer (DNR)", "somebodys"],
        ["per pixel, first layer", "wide"],
        ["per pixel, all layers (L1 alone)", "ours"],
        ["per pixel, all layers (L1, random VGG16)", "stand-in"],
        ["U-Net, all layers", "not run"],
        ["per pixel, all layers, tuned", "not run"],
        ["DNR", "somebodys"],
        ["paper (L1 alone)", "ours"],
        ["paper (L1, random VGG16)", "stand-in"],
        ["DeepVoxels, small", "voxels"],
        ["paper-best", "not run"],
        ["DNR, as the paper ran it", "not run"],
        ["the network of its code (L1 alone)", "not run"],
    ]
    assert [row[-2:] for row in rows if row[1] == "ours"] == [["33.19", "32.99"]] * 2


# The claims


def scored(dataset: Dataset, folder: Path, *names: str) -> SceneScores:
    truths: dict[Split, Truth] = {split: read_truth(dataset, split) for split in TEST_SPLITS}
    runs = tuple(score_run(open_run(folder / "synthetic" / name, folder), truths) for name in names)
    return SceneScores(dataset=dataset, title=folder.name, has_glass_mask=True, truths=truths, runs=runs)


def verdicts(scenes: list[SceneScores]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for finding in claims.find_claims(scenes, {}):
        found.setdefault(finding.claim[0], []).append(finding.verdict)
    return found


def test_claims_are_decided_by_intervals_over_enough_scenes_and_not_run_without_runs(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scenes = []
    for worse in (0, 2):
        folder = tmp_path / str(worse)
        write_run(dataset, folder, "view", paper(), 10 + worse, 11 + worse)
        write_run(dataset, folder, "unet", "dnr", 12 + worse, 20 + worse)
        write_run(dataset, folder, "unet-layers", "dnr-layers", 9 + worse, 9 + worse)
        write_run(dataset, folder, "sh", paper(extrinsics="sh", width=72), 9 + worse, 12 + worse)
        write_run(dataset, folder, "ellipsoid", paper(geometry="ellipsoid"), 20, 20)
        write_run(dataset, folder, "box", paper(geometry="box"), 22 + worse, 40)
        scenes.append(scored(dataset, folder, "view", "unet", "unet-layers", "sh", "ellipsoid", "box"))
    assert verdicts(scenes)["1"] == ["not decided"]
    monkeypatch.setattr(claims, "LEAST", 2)
    assert verdicts(scenes) == {
        "1": ["confirmed"],
        "2": ["confirmed"],
        "3": ["contradicted"],
        "4": ["confirmed", "contradicted"],
        "5": ["confirmed"],
        "6": ["not judged: no score of videos"],
        "7": ["not run"],
        "8": ["not run"],
        "9": ["not run"],
    }
    gaps = [decibels(10 + worse) - decibels(12 + worse) for worse in (0, 2)]
    finding = claims.find_claims(scenes, {})[0]
    assert (finding.scenes, finding.pair) == ("2", "view (L1 alone) against unet")
    assert finding.numbers.startswith(f"inter {statistics.fmean(gaps):+.2f} ({min(gaps):+.2f} to {max(gaps):+.2f})")
    tables(dataset, tmp_path / "0", "claims")
    first = rows_of(capsys.readouterr().out)[1]
    assert first[1:3] == ["synthetic", finding.pair] and first[-1] == "not decided"


def test_an_interval_has_its_nominal_width_over_pictures_and_over_seeds() -> None:
    rng = np.random.default_rng(5)
    one, other = rng.normal(31, 2, (1, 100)), np.full((1, 100), 30.0)
    gap = claims.bootstrap([one, one], [other, other], claims.NEAR)
    half = 1.96 * one.std() / 10
    assert gap.mean == pytest.approx(one.mean() - 30)
    assert (gap.low, gap.high) == pytest.approx((gap.mean - half, gap.mean + half), abs=0.04)
    # Seeds that differ, on pictures that do not, and a drop in which every seed's offset cancels.
    seeds = 31 + rng.normal(0, 1, (40, 1)) + np.zeros((40, 10))
    other = np.full((1, 10), 30.0)
    gap = claims.bootstrap([seeds, seeds], [other, other], claims.FAR)
    assert gap.high - gap.low == pytest.approx(2 * 1.96 * seeds.std() / 40**0.5, rel=0.05)
    drop = claims.bootstrap([seeds, seeds - 2], [other, other], claims.DROP)
    assert (drop.low, drop.high) == pytest.approx((2, 2))
    # Scenes differ, but each loses as much.
    one = one[:, :10]
    drop = claims.bootstrap([one, one - 3], [other, other], claims.DROP, of_scenes=True)
    assert (drop.low, drop.high) == pytest.approx((3, 3))


def test_edited_scenes_decide_whether_zero_layers_help_edits(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = []
    for name in ("a", "b"):
        write_run(dataset, tmp_path / name, "without", paper(), 10, 11)
        write_run(dataset, tmp_path / name, "with", paper(zero_layer=True), 10, 11)
        scenes.append(scored(dataset, tmp_path / name, "without", "with"))
    monkeypatch.setattr(claims, "LEAST", 2)
    both, alone = dict.fromkeys(TEST_SPLITS, 23.0), dict.fromkeys(TEST_SPLITS, 40.0)
    for edited_db, verdict in ((24.0, "confirmed"), (22.0, "contradicted")):
        drawn = {"with": {"x": dict.fromkeys(TEST_SPLITS, edited_db)}, "without": {"x": both, "y": alone}}
        found = {
            finding.claim[0]: finding.verdict for finding in claims.find_claims(scenes, dict.fromkeys("ab", drawn))
        }
        assert found["8"] == verdict and found["7"] == "not decided"
        assert claims.find_claims(scenes[:1], {"a": drawn})[-2].verdict == "not decided"


# What is refused, and what the records must be


def test_a_table_without_runs_names_the_sweep_that_makes_them(dataset: Dataset, tmp_path: Path) -> None:
    write_run(dataset, tmp_path, "view", paper(), 10, 11)
    for name, words in (("table2", "table2 --dataset "), ("claims", "claims")):
        with pytest.raises(HyalineError, match=rf"contains no run of {name}; make them with `model sweep {words}"):
            tables(dataset, tmp_path / "nowhere", name)


# Larger pictures


def test_larger_pictures_and_errors_by_what_pixels_show_have_tables(tmp_path: Path) -> None:
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

    # The same run's errors by what its pixels show.
    asked = f"report '{tmp_path}/runs' --data '{tmp_path}/data' --table errors --json"
    assert "has no twin without glass; make it with `datagen add" in call(asked).error
    run(f"datagen add '{tmp_path}/data/mine' --edit no-glass")
    ((_, _, *cells),) = json.loads(call(asked).out)["tables"]["errors"][0]["rows"]
    dataset = open_dataset(tmp_path / "data/mine")
    squares, glass = [], []
    for split in TEST_SPLITS:
        for view in dataset.views(split):
            drawn = read_png(tmp_path / f"runs/mine/paper/predictions/{split}/{view.index:04d}.png")
            squares.append(np.square(drawn - view.image.astype(float)).mean(axis=-1))
            glass.append(view.mask("glass"))
    in_glass = np.where(glass, squares, 0).mean()
    assert 0 < in_glass < np.mean(squares)
    assert [cells[0], cells[5]] == [f"{value:.1f}" for value in (in_glass, np.mean(squares))]
    assert sum(map(float, cells[:5])) == pytest.approx(np.mean(squares), abs=0.3)
    assert cells[6].count("g") == pytest.approx(20 * in_glass / np.mean(squares), abs=1)


def test_enlarging_keeps_a_ramp_where_it_was() -> None:
    """The centres of the larger picture's pixels lie at quarters between those of the smaller one's."""
    ramp = np.broadcast_to(8 * np.arange(16)[:, None, None] + 60, (16, 16, 3)).astype(np.uint8)
    large = enlarge(ramp, square(32))
    expected = 8 * ((np.arange(32) + 0.5) / 2 - 0.5) + 60
    assert np.abs(large[6:-6, 5, 1] - expected[6:-6]).max() <= 0.6
    assert np.array_equal(enlarge(ramp, square(16)), ramp)
