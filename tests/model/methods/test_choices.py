"""Tests of what `model train` can be told: flags, configurations, names of run folders."""

import dataclasses
import json
import math
from pathlib import Path

import pytest
from support.commands import call, run
from support.training import build, configured

from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.disk.records import to_json
from datagen.terminal.parsing import flag_words, flags_of
from model.methods.protocol import BUILT_IN, METHODS
from model.run.run_folder import read_run
from model.run.train_flags import Asked, flags_asked, folder_name, make_command, parse_train
from model.settings import WEIGHT_FILE, RunFlags


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("paper", "paper"),
        ("paper --geometry box --steps 10 --seed 2", "paper-box-10-steps-seed2"),
        (
            "paper --extrinsics none --hidden 256 --blocks 2 --norm none",
            "paper-no-extrinsics-w256-2-blocks-no-norm",
        ),
        (
            "paper --extrinsics sh --texture-size 64 --zero-layer --rays 4 --render-rays 1",
            "paper-sh-t64-zero-layer-4-rays",
        ),
        (
            "light-path --geometry box --texture-size 9 --rays 1 --branches 2 --stack 32 --straight-layers 0",
            "light-path-box-t9-1-rays-2-branches-stack32-0-straight",
        ),
        ("light-path --geometry box --stack 96 --relief", "light-path-box"),
        ("light-path --stack 96 --relief", "light-path-stack96-relief"),
        (
            "light-path --environment 1 --sky-lobes 3 --sky-lr 0.5 --refined-rays 9 --texture-levels 1",
            "light-path-9-refined-rays-sky1-3-lobes-sky-lr0.5-1-levels",
        ),
        (
            "paper --use-layers 2 --batch 64 --lr 0.1 --texture-lr 0.5 --lr-decay none --steps 10 --seed 2",
            "paper-2-layers-batch64-lr0.1-texture-lr0.5-no-decay-10-steps-seed2",
        ),
        ("paper --lr-decay cosine --updates 2", "paper-2-updates-cosine-decay"),
        ("paper-best", "paper-best"),
        ("paper-best --steps 2500 --norm none", "paper-best-2500-steps"),
        ("dnr-authors --features 8 --crop 0", "dnr-authors"),
        ("paper --vgg-weights random --adversarial 0.01", "paper-random-vgg-adversarial0.01"),
        ("paper-best --vgg-weights imagenet", "paper-best-vgg"),
    ],
)
def test_folders_tell_what_is_not_usual_for_the_method_its_preset_and_the_geometry(words: str, name: str) -> None:
    method, *flags = words.split()
    assert folder_name(method, parse_train(method, tuple(flags))) == name


@pytest.mark.parametrize(
    "words",
    [
        "paper --vgg-weights none",
        "paper --geometry box --extrinsics none --hidden 256 --blocks 0 --norm none --vgg-weights imagenet --seed 7",
        "paper-best --zero-layer --features 8 --lr-decay none --steps 10 --texture-lr 0.5",
        "paper --vgg-weights random --adversarial 0.01",
        "light-path --geometry box --no-relief --straight-layers 2 --environment 1 --sky-lr 0.5 --debias 0.5",
        "dnr-authors --crop 8",
    ],
)
def test_recorded_flags_ask_for_the_same_run_and_say_nothing_usual(words: str) -> None:
    method, *flags = words.split()
    asked = parse_train(method, tuple(flags))
    again = flag_words(flags_asked(asked).items())
    assert parse_train(method, tuple(again)) == asked and sorted(again) == sorted(flags)
    unrecorded = (*flags, "--out", "x", "--label", "y", "--costs", "--overwrite", "--device", "cpu")
    assert flags_asked(parse_train(method, unrecorded)) == flags_asked(asked)


def test_the_papers_loss_is_usual_where_torchs_cache_has_its_weights_and_folders_tell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def asked(method: str) -> Asked:
        usual = METHODS.find(method)().usual("truth")
        return Asked(dataset=None, run=RunFlags(), method=usual, optimisation=usual.optimisation())

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    place = tmp_path / "hub/checkpoints" / WEIGHT_FILE
    for weights, name in (("none", "paper"), ("imagenet", "paper-vgg")):
        assert flags_asked(asked("paper")) == flags_asked(asked("mlp-first")) == {"vgg-weights": weights}
        assert folder_name("paper", asked("paper")) == name and flags_asked(asked("dnr")) == {}
        place.parent.mkdir(parents=True, exist_ok=True)
        place.touch()


@pytest.mark.parametrize("method", BUILT_IN)
def test_every_flag_of_a_method_means_one_thing_and_marks_the_folder(method: str) -> None:
    record = METHODS.find(method)
    optimisation = type(record().optimisation())
    parts = [flags_of(part) for part in (RunFlags, record, optimisation)]
    assert sum(map(len, parts)) == len(flags_of(make_command(method, (), lambda *_: None)))
    for part in (record, optimisation):
        for item in dataclasses.fields(part):
            is_record = isinstance(item.type, type) and dataclasses.is_dataclass(item.type)
            assert is_record or item.metadata.get("is_hidden") or item.metadata["suffix"], item.name


LARGEST_OPEN = {"batch", "steps", "updates", "crop", "patch"}
"""Counts that memory and patience alone bound."""


@pytest.mark.parametrize("method", BUILT_IN)
def test_every_number_that_a_flag_takes_has_limits(method: str) -> None:
    usual = parse_train(method, ())
    records = (usual.run, usual.method, usual.optimisation, getattr(usual.optimisation, "loss", usual.run))
    tried = 0
    for name in flags_of(make_command(method, (), lambda *_: None)).values():
        record = next(part for part in records if hasattr(part, name))
        kind = {item.name: item.type for item in dataclasses.fields(record)}[name]
        impossible: list[float] = []
        if kind in (int, int | None):
            impossible = [-1] if name in LARGEST_OPEN else [-1, 10**21]
        elif kind in (float, float | None):
            impossible = [-0.1, math.nan, math.inf]
        for value in impossible:
            with pytest.raises(HyalineError, match=rf"{name.removeprefix('texture_')}: is {value}"):
                dataclasses.replace(record, **{name: value})
        tried += len(impossible)
    assert tried > 5


@pytest.mark.parametrize(
    ("words", "status", "line"),
    [
        ("papr", 2, "no model train method 'papr'; did you mean 'paper'? Choose from "),
        ("paper --sedd 3", 2, "model train paper: Unrecognized options: --sedd, 3; did you mean --seed INT"),
        ("paper --norm bach", 2, "model train paper: invalid choice 'bach' for argument '--norm'; choose from "),
        ("paper one two", 2, "model train paper: Unrecognized options: two. See `model train paper --help`"),
        ("paper --steps 0", 1, "--steps: is 0; expected at least 1"),
    ],
)
def test_a_wrong_word_is_answered_in_one_line(words: str, status: int, line: str) -> None:
    answer = call(f"model train {words}")
    assert answer.status == status
    assert answer.err.startswith(f"error: {line}") and answer.err.count("\n") == 1


def test_a_run_of_the_best_preset_is_called_so_and_records_every_choice(dataset: Dataset, tmp_path: Path) -> None:
    run(f"model train paper-best {dataset.root} --steps 3 --batch 64 --device cpu")
    (out,) = (tmp_path / "runs" / "synthetic").iterdir()
    assert out.name == "paper-best-batch64-3-steps"
    record = read_run(out)
    assert record.label == out.name
    assert record.config.net == configured(dataset, "paper-best").net
    assert json.loads((out / "run.json").read_text())["config"] == to_json(record.config)
    net = build(record.config.net, dataset).net
    assert record.num_parameters == sum(value.numel() for value in net.parameters())
