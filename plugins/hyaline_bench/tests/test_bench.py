"""Tests of the benchmark from predictions to the leaderboard, and of what it refuses."""

import dataclasses
import json
import math
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.builds import tree
from support.commands import call, run
from support.synthetic import look_at

from datagen.builder.choices import PRESETS
from datagen.data.cameras import Cameras
from datagen.data.config import ANGLE_SPLITS, TEST_SPLITS, square
from datagen.data.dataset import open_dataset
from datagen.data.images import png_bytes, read_png, srgb_from_linear
from datagen.data.paths import BUILT_IN_SCENES
from datagen.data.variants import ELSEWHERE, open_variant, read_edit_mask
from datagen.disk.errors import HyalineError
from datagen.disk.records import seal_bytes
from datagen.scene.edits import parse_edit
from eval.score.runs import Run, open_run
from hyaline_bench.cli import UNFITTED
from hyaline_bench.floors import nearest_view
from hyaline_bench.leaderboard import check_comparable, summarise
from hyaline_bench.protocol import ALL, EDITS, GLASS, Protocol, choose_track, glass_masks, load_protocol
from hyaline_bench.score import read_scored
from model.run.sweep import Experiment, read_experiment

SCORES = Path("bench/tiny/scores/nearest-view.json")
MEAN = Path("bench/tiny/scores/mean-picture.json")
PICTURE = Path("runs/synthetic-tiny/nearest-view/predictions/interpolating/0001.png")


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_protocol: Protocol) -> Path:
    """A copy of both datasets, as the working directory."""
    shutil.copytree(made / "data", tmp_path / "here" / "data")
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


@pytest.fixture
def predicted(here: Path) -> Path:
    """The same with the floors' predictions."""
    run("hyaline-bench floors --preset tiny")
    return here


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return 10 * math.log10(255**2 / np.mean((one.astype(float) - other) ** 2))


# From predictions to the leaderboard


def test_floors_are_scored_and_shown(predicted: Path, small_protocol: Protocol) -> None:
    answer = call("hyaline-bench score --preset tiny")
    assert answer.status == 0 and "glass dB of each scene" in answer.out
    assert (
        "synthetic: is not the protocol's dataset 0123456789ab, so" in answer.err and "random-nested" not in answer.err
    )
    scored = read_scored(SCORES)
    assert (scored.track, scored.preset, len(scored.scenes)) == ("pictures", "tiny", 2)
    for name, scene in scored.scenes.items():
        dataset = open_dataset(Path(f"data/{name}-tiny"))
        assert scene.dataset == dataset.seal
        sources = {"": (dataset, TEST_SPLITS, ALL), "no-glass": (dataset, TEST_SPLITS, GLASS)}
        if name == "synthetic":
            sources["angles"] = open_variant(dataset, "angles"), ["extrapolating-10deg"], "extrapolating-10deg"
            sources["remove-pane"] = open_variant(dataset, "remove-pane"), TEST_SPLITS, EDITS
        for variant, (source, splits, column) in sources.items():
            folder = Path(f"runs/{name}-tiny/nearest-view") / ("" if source is dataset else f"variants/{variant}")
            own, ceilings = [], []
            for view in (view for split in splits for view in source.views(split)):
                inside = (slice(view.index * 24, None), slice(16, None)) if column in (GLASS, EDITS) else (slice(None),)
                picture = read_png(folder / "predictions" / view.split / f"{view.index:04d}.png")
                own.append(psnr(picture[inside], view.image[inside]))
                noise = view.record.noise_mse
                if column in (GLASS, EDITS):
                    halves = (srgb_from_linear(view.radiance + sign * view.noise)[inside] for sign in (1, -1))
                    noise = np.mean(np.subtract(*halves) ** 2) / 4
                ceilings.append(-10 * np.log10(noise + 1 / 6 / 255**2))
            assert scene.psnr_db(column) == pytest.approx(np.mean(own))
            assert scene.ceiling_db(column) == pytest.approx(np.mean(ceilings))
        assert scene.splits["interpolating"].changed == pytest.approx((1 + 1 / 4) / 4)
        assert scene.train_noise_db == dataset.noise_ceiling_db("train")
    edited = summarise(scored, EDITS, small_protocol.bootstrap)
    assert edited is not None and edited.worst_scene == "synthetic" and edited.interval is None
    one, other = (scene.psnr_db(ALL) for scene in scored.scenes.values())
    summary = summarise(scored, ALL, small_protocol.bootstrap)
    assert summary is not None and one is not None and other is not None and summary.interval is not None
    assert (summary.worst, *summary.interval) == pytest.approx((min(one, other), min(one, other), max(one, other)))

    printed = call("hyaline-bench leaderboard --preset tiny").out
    assert printed.startswith("# hyaline-bench 3, tiny\n") and "## Track: pictures" in printed
    assert f"| {summary.mean:.2f} | " in printed and "## Track: shapes" not in printed
    row = next(line for line in printed.splitlines() if line.startswith("| synthetic | "))
    assert f" | {read_scored(MEAN).scenes['synthetic'].psnr_db(GLASS):.2f} | " in row
    assert row.split(" | ")[1] == open_dataset(Path("data/synthetic-tiny")).seal[:12]
    before = tree(predicted)
    for command in ("floors", "score"):
        run(f"hyaline-bench {command} --preset tiny")
    assert tree(predicted) == before


def test_a_foreign_method_names_its_track_and_need_not_predict_edits(predicted: Path) -> None:
    for name in ("synthetic", "random-nested-7100"):
        folder = Path(f"runs/{name}-tiny/mine")
        shutil.copytree(f"runs/{name}-tiny/mean-picture", folder)
        (folder / "run.json").unlink()
        (folder / "costs.json").write_text('{"cpu_seconds": 90, "frames_per_second": 5}')
    shutil.rmtree("runs/synthetic-tiny/mine/variants/remove-pane")
    assert "name the track with --track" in call("hyaline-bench score mine --preset tiny").error
    Path("runs/gone/mine/predictions/interpolating").mkdir(parents=True)
    answer = call("hyaline-bench score mine --preset tiny --track masks")
    assert answer.status == 0 and "left out: runs/gone/mine: no dataset at data/gone" in answer.err
    scored = read_scored(SCORES.with_name("mine.json"))
    assert scored.track == "masks" and not scored.scenes["synthetic"].values(EDITS)
    assert scored.scenes["synthetic"].costs == {"cpu_seconds": 90, "frames_per_second": 5}
    assert re.search(r"\| mine \| 2/4 .*\| 1.50 \|", call("hyaline-bench leaderboard --preset tiny").out)


def test_predictions_for_other_data_are_not_scored(predicted: Path) -> None:
    for path in Path("runs").glob("*/nearest-view/run.json"):
        path.write_text(path.read_text().replace('"dataset_seal": "', '"dataset_seal": "0'))
    answer = call("hyaline-bench score --preset tiny")
    assert answer.status == 0 and "the predictions are for other data" in answer.err
    assert not SCORES.exists() and MEAN.exists()
    assert "no method 'nearest-view'" in call("hyaline-bench score nearest-view --preset tiny").error
    shutil.copytree("data", "kept")
    shutil.rmtree("data/random-nested-7100-tiny")
    for path in Path("runs").glob("random-*/mean-picture/run.json"):
        path.write_text(path.read_text().replace("data/random", "kept/random"))
    answer = call("hyaline-bench score mean-picture --preset tiny")
    assert answer.status == 0 and "which is not in data; set --data" in answer.err
    assert set(read_scored(MEAN).scenes) == {"synthetic"}


def test_files_that_are_no_scores_of_this_protocol_are_named_and_left_out(predicted: Path) -> None:
    run("hyaline-bench score --preset tiny")
    content = json.loads(SCORES.read_text())
    del content["sha256"]
    folder = SCORES.parent
    for name, keys in {"older": {"version": 1}, "magic": {"track": "magic"}}.items():
        (folder / f"{name}.json").write_bytes(seal_bytes(content | keys))
    answer = call(f"hyaline-bench leaderboard {folder}")
    assert answer.status == 0
    assert "left out: bench/tiny/scores/older.json: was scored with protocol 1; expected 3" in answer.err
    assert "left out: bench/tiny/scores/magic.json: is of the track 'magic'; expected one of pictures" in answer.err


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("predictions/interpolating/0001.png", "0001.png: missing; expected 0000"),
        ("variants/angles", "the protocol asks for extrapolating-10deg"),
        ("predictions/extrapolating", "the protocol asks for all its views"),
    ],
)
def test_incomplete_predictions_are_not_scored(predicted: Path, file: str, message: str) -> None:
    path = Path("runs/synthetic-tiny/nearest-view") / file
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    answer = call("hyaline-bench score nearest-view --preset tiny")
    assert answer.status == 1 and re.search(message, answer.error) and not SCORES.exists()
    run("hyaline-bench score --preset tiny")  # The other floor is complete.
    assert MEAN.exists() and not SCORES.exists()
    shutil.rmtree("runs/synthetic-tiny/mean-picture/predictions/extrapolating")
    assert "no method could be scored at tiny" in call("hyaline-bench score --preset tiny").error


# The truth's noise


@pytest.mark.parametrize("split", ["interpolating", "extrapolating-10deg", "edit"])
def test_one_near_copy_of_the_truth_among_bad_views_is_refused_by_its_name(predicted: Path, split: str) -> None:
    dataset = open_dataset(Path("data/synthetic-tiny"))
    folder = Path("runs/synthetic-tiny/nearest-view")
    if split == "edit":
        dataset, folder, split = open_variant(dataset, "remove-pane"), folder / "variants/remove-pane", "interpolating"
    elif split == "extrapolating-10deg":
        dataset, folder = open_variant(dataset, "angles"), folder / "variants/angles"
    near = read_png(dataset.root / "images" / split / "0001.png").copy()
    near[0, 0, 0] ^= 1
    path = folder / "predictions" / split / "0001.png"
    path.write_bytes(png_bytes(near))
    path.with_name("0000.png").write_bytes(png_bytes(np.zeros_like(near)))
    answer = call("hyaline-bench score nearest-view --preset tiny")
    assert answer.status == 1 and f"{path}: a PSNR of " in answer.error
    assert "is above the noise ceiling of " in answer.error and not SCORES.exists()


def write_noisy(psnr_db: float, glass_db: float | None = None) -> None:
    """Predicts a split with so much noise beside the truth, whose own noise allows 50 dB; with other noise in glass."""
    dataset = open_dataset(Path("data/synthetic-tiny"))
    without_glass = dataclasses.replace(dataset, root=glass_masks(dataset).parent)
    for view in dataset.views("interpolating"):
        mask = read_edit_mask(without_glass, "interpolating", view.index)
        decibels = np.where(mask == ELSEWHERE, psnr_db, glass_db or psnr_db)[..., None]
        noise = np.random.default_rng(view.index).normal(0, 255 * 10 ** (-decibels / 20), view.image.shape)
        picture = np.clip(np.rint(np.clip(view.image, 9, 246) + noise), 0, 255).astype(np.uint8)
        PICTURE.with_name(f"{view.index:04d}.png").write_bytes(png_bytes(picture))


def test_a_perfect_method_is_scored_and_one_a_little_too_good_everywhere_is_refused(predicted: Path) -> None:
    del predicted
    write_noisy(50)
    run("hyaline-bench score nearest-view --preset tiny")
    write_noisy(52.2)
    answer = call("hyaline-bench score nearest-view --preset tiny")
    assert answer.status == 1
    assert re.search(r"predictions/interpolating: a PSNR of 5[12]\.\d dB is above the noise ceiling", answer.error)
    write_noisy(30, glass_db=58)  # Copied where methods are ranked, bad elsewhere.
    answer = call("hyaline-bench score nearest-view --preset tiny")
    assert re.search(r"predictions/interpolating: a PSNR of 5[678]\.\d dB is above the noise ceiling", answer.error)


def test_scores_on_another_dataset_of_a_scene_do_not_enter_a_table(predicted: Path, small_protocol: Protocol) -> None:
    run("hyaline-bench score --preset tiny")
    scored = read_scored(MEAN)
    scene = dataclasses.replace(scored.scenes["synthetic"], dataset="0" * 64)
    other = dataclasses.replace(scored, name="other", scenes={**scored.scenes, "synthetic": scene})
    check_comparable([scored, dataclasses.replace(scored, name="again")])
    with pytest.raises(HyalineError, match="other: was scored on another dataset of synthetic"):
        check_comparable([scored, other])
    with pytest.raises(HyalineError, match="nearest-view: was scored at small, others at tiny"):
        check_comparable([scored, dataclasses.replace(scored, name="nearest-view", preset="small")])


# Tracks


def run_with(made: Path, *, seal: str | None, **known: Any) -> Run:
    """A run whose record says this; with a seal, one of `model train`."""
    found = open_run(made / "runs" / "synthetic-tiny" / "one", made / "data")
    return dataclasses.replace(found, seal=seal, record=dataclasses.replace(found.record, **known))


@pytest.mark.parametrize(
    ("geometry", "uses_materials", "told", "track"),
    [
        ("none", False, None, "pictures"),
        ("none", True, None, "materials"),
        (None, True, None, "materials"),
        ("fitted", True, (), "masks"),
        ("fitted", True, None, "materials"),
        ("fitted", True, ("floor",), "materials"),
        ("fitted", False, None, "masks"),
        ("fitted", False, ("pane",), "shapes"),
        ("fitted-hull", True, (), "masks"),
        ("fitted-materials", True, (), "shapes"),
        ("ellipsoid", False, None, "proxies"),
        ("ellipsoid", True, None, "materials"),
        ("mixed-b", False, None, "shapes"),
        ("truth", False, None, "shapes"),
        ("truth", True, None, "materials"),
    ],
)
def test_a_run_belongs_to_the_first_track_that_may_be_told_as_much(
    made: Path,
    small_protocol: Protocol,
    geometry: str | None,
    uses_materials: bool,
    told: tuple[str, ...] | None,
    track: str,
) -> None:
    known = {"geometry": geometry, "uses_materials": uses_materials, "told": told}
    found, of_any = (run_with(made, seal=seal, **known) for seal in ("of model train", None))
    assert choose_track(found, None, small_protocol.tracks) == track
    assert choose_track(found, "materials", small_protocol.tracks) == "materials"
    for lower in list(small_protocol.tracks)[: list(small_protocol.tracks).index(track)]:
        with pytest.raises(HyalineError, match=f"that the track {lower} does not allow; submit it to {track}"):
            choose_track(found, lower, small_protocol.tracks)
    if geometry != "none":  # The record of a foreign method may leave out what it was told.
        with pytest.raises(HyalineError, match="does not show all inputs of the method; name the track"):
            choose_track(of_any, None, small_protocol.tracks)


# Floors and averages


def test_the_nearest_view_is_chosen_by_cameras_alone() -> None:
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(9, 3)) + np.array([0, 0, 2])
    poses = np.stack([look_at(3 * way / np.linalg.norm(way), np.zeros(3)) for way in ways])
    train = Cameras(world_from_camera=poses, fov_x=1.0, width=4, height=4)
    pictures = np.arange(9, dtype=np.uint8)[:, None, None, None] * np.ones((1, 4, 4, 3), np.uint8)
    shuffled = rng.permutation(9)
    nudged = poses[shuffled].copy()
    nudged[:, :3, 3] += 1e-3
    test = Cameras(world_from_camera=nudged, fov_x=1.0, width=4, height=4)
    assert nearest_view(pictures, train, test)[:, 0, 0, 0].tolist() == shuffled.tolist()
    # At one place, the viewing direction decides.
    turned = np.stack([look_at(np.array([0.0, 0, 3]), np.array(target)) for target in ([0.1, 0, 0], [3.0, 0, 3])])
    pair = Cameras(world_from_camera=turned, fov_x=1.0, width=4, height=4)
    asked = Cameras(world_from_camera=turned[1:], fov_x=1.0, width=4, height=4)
    assert nearest_view(pictures[:2], pair, asked)[0, 0, 0, 0] == 1


# The protocol, which names what `datagen` makes, and its sweep

PROTOCOL = load_protocol()


def test_scenes_sizes_splits_and_edits_are_those_of_datagen() -> None:
    assert list(PROTOCOL.scenes) == list(BUILT_IN_SCENES)
    assert all(len(edits) == 2 and all(map(parse_edit, edits)) for edits in PROTOCOL.scenes.values())
    assert list(PROTOCOL.splits) == [*TEST_SPLITS, *ANGLE_SPLITS]
    for name, size in PROTOCOL.presets.items():
        made = PRESETS[name]
        assert (made.resolution, made.train, made.interpolating) == (square(size.resolution), size.train, size.test)


def datasets_of(experiment: Experiment) -> dict[str, set[str]]:
    """The datasets that each method with its geometry is trained on."""
    found: dict[str, set[str]] = {}
    for method, dataset, *flags in experiment.runs:
        geometry = flags[flags.index("--geometry") + 1] if "--geometry" in flags else ""
        assert "--costs" in flags
        found.setdefault(f"{method} {geometry}", set()).add(dataset)
    return found


@pytest.mark.parametrize("preset", PROTOCOL.presets)
def test_the_commands_train_every_method_on_every_public_scene_and_predict_every_edit(
    preset: str, tmp_path: Path
) -> None:
    (tmp_path / "bench.txt").write_text(call(f"hyaline-bench commands --preset {preset}").out)
    experiment = read_experiment(str(tmp_path / "bench.txt"))
    scenes = PROTOCOL.public_scenes(preset)
    found = datasets_of(experiment)
    assert len(found) == (8 if preset in ("tiny", "small") else 9)  # With deepvoxels.
    assert all(datasets == {f"{scene}-{preset}" for scene in scenes} for datasets in found.values())
    edited = [shlex.split(line)[2:] for line in experiment.then if line.startswith("model predict")]
    for scene in scenes:
        assert f"datagen add {scene}-{preset} --edit no-glass" in experiment.needs
        assert (f"datagen add {scene}-{preset} --angles" in experiment.needs) == (scene in PROTOCOL.scenes)
        runs = {run for run, _, _ in edited if f"runs/{scene}-{preset}/" in run}
        assert len(runs) == (7 if PROTOCOL.scenes.get(scene) else 0)
        for edit in PROTOCOL.scenes.get(scene, ()):
            assert f"datagen add {scene}-{preset} --edit {edit}" in experiment.needs
            assert all([run, "--variant", edit] in edited for run in runs)
    assert experiment.then[-1] == f"hyaline-bench leaderboard --preset {preset}"


def test_the_track_of_masks_trains_on_fitted_glass(tmp_path: Path) -> None:
    (tmp_path / "bench.txt").write_text(call("hyaline-bench commands --preset small --fitted").out)
    experiment = read_experiment(str(tmp_path / "bench.txt"))
    fitted = {f"{scene}-small" for scene in PROTOCOL.public_scenes("small")} - {f"{scene}-small" for scene in UNFITTED}
    assert datasets_of(experiment) == {"light-path fitted": fitted} and len(fitted) == 15
    assert "model fit glass_table-small --room matt" in experiment.needs and experiment.then == ()
