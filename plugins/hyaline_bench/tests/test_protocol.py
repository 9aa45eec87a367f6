"""Tests that the protocol names what `datagen` makes, and that the sweep covers it."""

import shlex
from pathlib import Path

import pytest
from support.commands import call

from datagen.builder.choices import PRESETS
from datagen.data.config import ANGLE_SPLITS, TEST_SPLITS, square
from datagen.data.paths import BUILT_IN_SCENES
from datagen.scene.edits import parse_edit
from hyaline_bench.protocol import load_protocol
from hyaline_random.names import FAMILIES, parse_random
from model.run.sweep import Experiment, read_experiment

PROTOCOL = load_protocol()


def test_scenes_sizes_splits_and_edits_are_those_of_datagen() -> None:
    assert list(PROTOCOL.scenes) == list(BUILT_IN_SCENES)
    assert all(len(edits) == 2 and all(map(parse_edit, edits)) for edits in PROTOCOL.scenes.values())
    assert list(PROTOCOL.splits) == [*TEST_SPLITS, *ANGLE_SPLITS]
    for name, size in PROTOCOL.presets.items():
        made = PRESETS[name]
        assert (made.resolution, made.train, made.interpolating) == (square(size.resolution), size.train, size.test)


def test_there_are_six_built_in_sixteen_random_and_eight_hidden_scenes_of_three_families() -> None:
    public = PROTOCOL.public_scenes("demo")
    named = [parse_random(scene) for scene in public[6:]]
    assert (len(public), len(PROTOCOL.hidden_scenes("demo"))) == (22, 8)
    assert [name.seed for name in named if name] == list(range(7100, 7116))
    assert {name.family for name in named if name} == set(FAMILIES.built_in)
    assert list(PROTOCOL.tracks) == ["pictures", "masks", "proxies", "shapes", "materials"]


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
    assert datasets_of(experiment) == {"light-path fitted": {"glass_table-small", "plant_shelf-small", "drinks-small"}}
    assert experiment.needs[2] == "model fit glass_table-small --room matt" and experiment.then == ()
