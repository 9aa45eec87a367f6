"""Tests of experiment files and of sweeps: grids equal to commands, sweeps that survive a kill."""

import io
import shlex
import sys
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
import torch
from support import commands
from support.synthetic import write_synthetic_dataset

from datagen.disk.errors import HyalineError
from model.run import sweep
from model.run.sweep import read_experiment
from model.run.train_flags import parse_train


def write(folder: Path, text: str) -> str:
    path = folder / "grid.txt"
    path.write_text(text)
    return str(path)


# Files


def test_braces_are_every_combination_in_the_order_of_the_file(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        """
        # A comment.
        datagen build {one,'my two'} --preset tiny   # As in a shell.
        model train paper {one,'my two'} --{no-,}zero-layer --lr 1e-4 --steps 10
        model export $run --out $run/scene.html
        model train paper --dataset one --extrinsics {view,sh} --lr 0.0001 --steps 10 --label Mine
        datagen build one --preset tiny
        hyaline-bench floors
    """,
    )
    asked = read_experiment(path)
    expected = []
    for dataset in ("one", "'my two'"):
        for zero in ("--no-zero-layer ", "--zero-layer "):
            expected.append(f"model train paper {dataset} {zero}--lr 1e-4 --steps 10")
    expected.append("model train paper --dataset one --extrinsics sh --lr 0.0001 --steps 10 --label Mine")
    assert list(map(sweep.command_line, asked.runs)) == expected
    assert asked.needs == ("datagen build one --preset tiny", "datagen build 'my two' --preset tiny")
    names = ("paper-lr0.0001-10-steps", "paper-zero-layer-lr0.0001-10-steps")
    folders = [f"runs/{dataset}/{name}" for dataset in ("one", "my two") for name in names]
    exports = [shlex.join(["model", "export", folder, "--out", f"{folder}/scene.html"]) for folder in folders]
    assert asked.then == (*exports, "hyaline-bench floors")

    replaced = read_experiment(path, datasets=["three"], seeds=[4, 5])
    parsed = [parse_train(method, tuple(words)) for method, *words in replaced.runs]
    assert [(asked.dataset, asked.run.seed) for asked in parsed] == [("three", 4), ("three", 5)] * 3
    assert replaced.needs == () and len(replaced.then) == 5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("model train papr", "no method 'papr'; did you mean 'paper'"),
        ("model train", "no method ''"),
        ("model train paper --extrinsic sh", "Unrecognized options: --extrinsic"),
        ("model train paper a --steps {10,many}", "Error parsing --steps"),
        ("model train {paper,light-path} --extrinsics sh", "model train light-path: Unrecognized"),
        ("rm -r data", "no program 'rm'"),
        ("model 'train", 'is "model \'train"; expected a command line'),
        ("model train paper --seed {" + ",".join(map(str, range(1001))) + "}", "means 1001 lines; expected at most 1,"),
        ("datagen build glass_table", "has no runs; expected at least one line"),
    ],
)
def test_what_no_command_could_be_is_named_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(HyalineError, match=f"grid.txt: line [0-9]+: .*{message}|grid.txt: {message}"):
        read_experiment(write(tmp_path, text))


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(HyalineError, match="no experiment 'tabel1'; did you mean 'table1'"):
        read_experiment("tabel1")
    with pytest.raises(HyalineError, match=r"mine\.txt"):
        read_experiment(str(tmp_path / "mine.txt"))


def test_lines_from_stdin_are_an_experiment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"model train paper one --seed {0,1}")))
    answer = commands.call("model sweep - --dry-run")
    assert answer.out.splitlines() == ["model train paper one --seed 0", "model train paper one --seed 1"]


def test_a_command_before_that_fails_stops_the_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep, "_train_in_child", lambda *_, **__: pytest.fail("a run was started"))
    (tmp_path / "stop.py").write_text("raise SystemExit(3)")
    (tmp_path / "go.py").write_text("open('gone', 'w')")
    path = write(tmp_path, "python go.py\npython stop.py\nmodel train paper")
    answer = commands.call(f"model sweep {path}")
    assert answer.status == 1
    assert "sweep grid: `python stop.py` ended with status 3, for the reason above" in answer.err
    assert (tmp_path / "gone").exists()


# Sweeps


def test_failed_runs_are_named_and_what_commands_on_finished_runs_print_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sweep, "_train_in_child", lambda words, *_: "no proxies" if "box" in words else "")
    path = write(tmp_path, "model train paper one\nreport --help\neval report --help")
    assert commands.call(f"model sweep {path}").status == 0
    assert capfd.readouterr().out.count("usage: ") == 2
    answer = commands.call(f"model sweep {write(tmp_path, 'model train paper one --geometry {truth,box}')}")
    failed, error = answer.err.splitlines()[-2:]
    assert answer.status == 1 and failed.startswith("failed: model train paper one --geometry box: no proxies")
    assert error.startswith("error: sweep grid: 1 of 2 jobs failed")


def test_each_device_runs_one_process_at_a_time_and_none_is_idle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = read_experiment(write(tmp_path, "model train paper --seed {" + ",".join(map(str, range(12))) + "}"))
    busy: Counter[str] = Counter()
    lock, all_three = threading.Lock(), threading.Barrier(3, timeout=120)

    def train(
        arguments: tuple[str, ...], place: str, environment: dict[str, str], children: object, is_stopped: object
    ) -> str:
        (device,) = environment.values()
        with lock:
            busy[device] += 1
            assert busy[device] == 1
        all_three.wait()  # Breaks, and with it the sweep, unless every device is busy.
        with lock:
            busy[device] -= 1
        return place if int(arguments[-1]) % 5 == 3 else ""

    monkeypatch.setattr(sweep, "_train_in_child", train)
    failures = sweep.run_experiment(experiment, devices=("0", "GPU-b", "2"))
    assert failures == {f"model train paper --seed {seed}": f"[{seed + 1}/12]" for seed in (3, 8)}
    assert set(busy) == {"0", "GPU-b", "2"}


@pytest.mark.parametrize(
    ("visible", "count", "jobs", "devices"),
    [
        (None, 0, 2, (None, None)),
        (None, 2, 2, ("0", "1", "0", "1")),
        ("3,GPU-abc", 2, 1, ("3", "GPU-abc")),
        ("", 0, 1, (None,)),
    ],
)
def test_devices_are_those_that_may_be_seen(
    monkeypatch: pytest.MonkeyPatch, visible: str | None, count: int, jobs: int, devices: tuple[str | None, ...]
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    monkeypatch.setattr("datagen.machine.processes.num_cores", lambda: 5)
    assert sweep.find_devices(jobs) == devices
    with pytest.raises(HyalineError, match="jobs: is 0; expected at least 1"):
        sweep.find_devices(0)
    # More jobs than cores leave each a thread; a single one keeps what its user has set.
    assert [sweep.share_of_cores(jobs).get("OMP_NUM_THREADS") for jobs in (1, 2, 6)] == [None, "2", "1"]


def test_a_sweep_in_jobs_has_one_for_each_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[Mapping[str, Sequence[str]]] = []

    def run_in_jobs(program: str, jobs: Mapping[str, Sequence[str]], *where: object) -> dict[str, str]:
        assert (program, *where[:2]) == ("model", Path("runs/jobs"), "slurm")
        sent.append(jobs)
        return {list(jobs)[-1]: "it was cancelled"}

    monkeypatch.setattr("model.run.sweep.run_in_jobs", run_in_jobs)
    block = "model train paper synthetic --steps 3 --seed {0,1}"
    write_synthetic_dataset(tmp_path / "data" / "synthetic", resolution=8, train_views=1)
    answer = commands.call(f"model sweep {write(tmp_path, block)} --launcher slurm")
    assert [shlex.join(["model", *words]) for words in sent[0].values()] == list(sent[0])
    assert answer.status == 1 and "1 of 2 runs are finished" in answer.err and "it was cancelled" in answer.err
