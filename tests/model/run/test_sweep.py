"""Tests of experiment files and of sweeps: grids equal to commands, sweeps that survive a kill."""

import os
import shlex
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
import torch
from support import commands
from support.synthetic import write_synthetic_dataset
from support.training import call

from datagen.disk.errors import HyalineError
from model.methods.paper.config import PaperConfig
from model.run import sweep
from model.run.experiments import STEP_CPU_MS, read_experiment
from model.run.train_flags import parse_train


def write(folder: Path, text: str) -> str:
    path = folder / "grid.toml"
    path.write_text(text)
    return str(path)


# Files


def test_a_grid_is_every_combination_in_the_order_of_the_file(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        """
        [[runs]]
        dataset = ["one", "my two"]
        method = "paper"
        zero-layer = [false, true]
        lr = 1e-4
        [[runs]]
        dataset = "one"
        method = "paper"
        extrinsics = ["view", "sh"]   # The default, and so the same run as without it.
        lr = 0.0001
    """,
    )
    commands = [sweep.command_line(arguments) for arguments in read_experiment(path).runs]
    expected = []
    for dataset in ("one", "'my two'"):
        for zero in ("--no-zero-layer ", "--zero-layer "):
            expected.append(f"model train paper {dataset} {zero}--lr 0.0001")
    assert commands == [*expected, "model train paper one --extrinsics sh --lr 0.0001"]
    method, *flags = shlex.split(commands[3])[2:]
    asked = parse_train(method, tuple(flags))
    assert isinstance(asked.method, PaperConfig)
    assert (asked.dataset, asked.method.zero_layer, asked.optimisation.lr) == ("my two", True, 1e-4)

    replaced = read_experiment(path, datasets=["three"], seeds=[4, 5]).runs
    parsed = [parse_train(method, tuple(words)) for method, *words in replaced]
    assert [(asked.dataset, asked.run.seed) for asked in parsed] == [("three", 4), ("three", 5)] * 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[runs]]\nmethod = "paper"\nextrinsic = "sh"', r"runs\[0\]: unknown key 'extrinsic'; did you mean 'ext"),
        ('[[runs]]\nmethod = "paper"\n[[runs]]\nmethod = "paper"\nzero_layer = true', "unknown key 'zero_layer'"),
        ('[[runs]]\nmethod = ["paper", "light-path"]\nextrinsics = "sh"', "`model train light-path` without its"),
        ('[[run]]\nmethod = "paper"', "unknown key 'run'; known are about, datasets, presets and runs"),
        ('[[runs]]\nmethod = "paper"\nsteps = [10, "many"]', "steps is 'many', which `model train` does not take"),
        ('[[runs]]\nmethod = "paper"\nextrinsics = "all"', "extrinsics is 'all', which `model train` does not take"),
        ('[[runs]]\nmethod = "paper"\nzero-layer = "yes"', "zero-layer is 'yes'; expected true or false"),
        ('[[runs]]\nmethod = "paper"\nsteps = false', "steps is False; expected a number or text"),
        ('[[runs]]\nmethod = "paper"\nout = "here"', "out cannot be set in an experiment; leave it out"),
        ('[[runs]]\nmethod = "paper"\nout = "here"', "out cannot be set in an experiment; leave it out"),
        ('[[runs]]\nmethod = "paper"\nseed = []', "seed is an empty list; expected at least one value"),
        ("[[runs]]\nseed = 1", 'key "method" is missing'),
        ('about = "nothing"', "has no runs; expected at least one"),
        ("about = 3\n[[runs]]", "about is 3; expected text"),
        ('presets = ["tiny"]\n[[runs]]\nmethod = "paper"', "presets is \\['tiny'\\]; expected tables"),
        ("[[runs]", "not TOML"),
        (
            '[[runs]]\nmethod = "paper"\nneeds = "datagen build"',
            r"runs\[0\]: needs is 'datagen build'; expected a list",
        ),
        ('[[runs]]\nmethod = "paper"\nneeds = ["rm -r data"]', r"runs\[0\]: needs: no program 'rm'"),
        ('[[runs]]\nmethod = "paper"\nthen = ["model \'"]', r"runs\[0\]: then is \"model '\"; expected a command line"),
    ],
)
def test_what_no_command_could_be_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(HyalineError, match=message):
        read_experiment(write(tmp_path, text))


def test_a_preset_fills_names_and_gives_flags_to_its_blocks(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        """
        [presets.demo]
        [presets.tiny]
        steps = 5
        only = ["one-{preset}", "two-{preset}"]
        [[runs]]
        needs = ["datagen build {scene} --preset {preset} --out data/{dataset}"]
        dataset = ["one-{preset}", "two-{preset}"]
        method = "paper"
        [[runs]]
        needs = ["datagen add {dataset} --angles"]
        dataset = "three-{preset}"
        method = "paper"
    """,
    )
    usual, tiny = read_experiment(path), read_experiment(path, preset="tiny")
    assert usual == read_experiment(path, preset="demo")
    assert [" ".join(run) for run in usual.runs] == ["paper one-demo", "paper two-demo", "paper three-demo"]
    assert [" ".join(run) for run in tiny.runs] == ["paper one-tiny --steps 5", "paper two-tiny --steps 5"]
    assert len(tiny.needs) == 2 and tiny.needs[1] == "datagen build two --preset tiny --out data/two-tiny"
    with pytest.raises(HyalineError, match="no preset 'huge'; choose from demo, tiny"):
        read_experiment(path, preset="huge")
    with pytest.raises(HyalineError, match="has no presets; leave out --preset"):
        read_experiment("random", preset="tiny")


def test_a_preset_may_leave_methods_out_and_give_each_flags_of_its_own(tmp_path: Path) -> None:
    text = """
        datasets = ["one", "two"]
        [presets.all]
        [presets.few]
        steps = 9
        methods.paper.steps = 7
        methods.light-path = {}
        [[runs]]
        method = ["paper", "dnr", "light-path"]
        [[runs]]
        dataset = "three"
        method = "dnr"
    """
    path = write(tmp_path, text)
    assert [run[0] for run in read_experiment(path).runs] == ["paper", "dnr", "light-path"] * 2 + ["dnr"]
    few = [" ".join(run) for run in read_experiment(path, preset="few").runs]
    assert few == ["paper one --steps 7", "light-path one --steps 9", "paper two --steps 7", "light-path two --steps 9"]
    unknown = write(tmp_path, text.replace("paper.steps", "paper.step"))
    with pytest.raises(HyalineError, match="unknown key 'step'; did you mean 'steps'"):
        read_experiment(unknown, preset="few")
    misspelt = write(tmp_path, text.replace("methods.paper.", "methods.papr."))
    with pytest.raises(HyalineError, match="no method 'papr'; did you mean 'paper'"):
        read_experiment(misspelt, preset="few")
    no_list = write(tmp_path, text.replace('["one", "two"]', '"one"'))
    with pytest.raises(HyalineError, match="datasets is 'one'; expected a list of texts"):
        read_experiment(no_list)
    no_table = write(tmp_path, text.replace("methods.light-path = {}", "methods.light-path = 3"))
    with pytest.raises(HyalineError, match="expected a table of each method's flags"):
        read_experiment(no_table, preset="few")


def test_commands_before_and_after_are_filled_in_and_given_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(
        tmp_path,
        """
        [[runs]]
        needs = ["datagen build {dataset}", "datagen add {dataset} --larger 2"]
        dataset = ["one", "my two"]
        method = "paper"
        steps = 10
        then = ["model predict {run} --variant x2"]
        [[runs]]
        needs = ["datagen build {dataset}"]
        dataset = "one"
        method = "paper"
        seed = [0, 1]
    """,
    )
    assert call(monkeypatch, "sweep", path, "--dry-run") == 0
    said = capsys.readouterr()
    assert said.out.splitlines() == [
        "datagen build one",
        "datagen add one --larger 2",
        "datagen build 'my two'",
        "datagen add 'my two' --larger 2",
        "model train paper one --steps 10",
        "model train paper 'my two' --steps 10",
        "model train paper one --seed 0",
        "model train paper one --seed 1",
        "model predict runs/one/paper-10-steps --variant x2",
        "model predict 'runs/my two/paper-10-steps' --variant x2",
    ]
    hours = (2 * 10 + 2 * 2500) * STEP_CPU_MS["paper"] / 3.6e6
    assert f"sweep grid: 4 runs, about {hours:.1f} CPU hours" in said.err
    other = read_experiment(path, datasets=["three"])
    assert other.needs == () and other.then == ("model predict runs/three/paper-10-steps --variant x2",)


def test_a_command_before_that_fails_stops_the_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sweep, "_train_in_child", lambda *_, **__: pytest.fail("a run was started"))
    (tmp_path / "stop.py").write_text("raise SystemExit(3)")
    (tmp_path / "go.py").write_text("open('gone', 'w')")
    path = write(tmp_path, '[[runs]]\nmethod = "paper"\nneeds = ["python go.py", "python stop.py"]')
    assert call(monkeypatch, "sweep", path) == 1
    assert "sweep grid: `python stop.py` ended with status 3, for the reason above" in capsys.readouterr().err
    assert (tmp_path / "gone").exists()


def test_a_file_that_is_missing_names_those_that_are_there(tmp_path: Path) -> None:
    with pytest.raises(HyalineError, match="no experiment 'tabel1'; did you mean 'table1'"):
        read_experiment("tabel1")
    with pytest.raises(HyalineError, match="the file is missing; built-in experiments are bench, b"):
        read_experiment(str(tmp_path / "mine.toml"))


def test_a_method_that_does_not_exist_stops_the_sweep_before_its_first_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sweep, "run_experiment", lambda *_, **__: pytest.fail("a run was started"))
    path = write(tmp_path, '[[runs]]\nmethod = ["paper", "papr"]')
    assert call(monkeypatch, "sweep", path) == 1
    assert "runs[0]: no method 'papr'; did you mean 'paper'?" in capsys.readouterr().err


# Sweeps


@pytest.mark.full
def test_a_sweep_that_was_stopped_and_then_killed_goes_on_to_the_bytes_of_train_and_tells_what_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_synthetic_dataset(tmp_path / "data" / "synthetic")
    size = {"method": "paper", "steps": 200, "batch": 64, "texture-size": 16, "hidden": 32}
    block = "[[runs]]\n" + "".join(f"{key} = {value!r}\n" for key, value in size.items())
    path = write(tmp_path, f'{block}seed = [0, 1]\n{block}geometry = "box"\n')
    command = [sys.executable, "-m", "model", "sweep", path]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    runs = tmp_path / "runs" / "synthetic"
    last = runs / "paper-w32-t16-batch64-200-steps-seed1"

    for number in (signal.SIGTERM, signal.SIGKILL):
        started = subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True)
        assert started.stderr is not None
        for line in started.stderr:
            if line.startswith("[2/3] ") and "training views" in line:
                break
        started.send_signal(number)
        _, said = started.communicate(timeout=120)
        if number == signal.SIGTERM:
            assert started.returncode == 143
            assert "[2/3] error: " in said and "stopped" in said
            assert said.endswith("error: stopped; run the same command again to continue\n")
        else:
            assert started.returncode == -signal.SIGKILL
        assert (last / "run.json").is_file() and not (last / "predictions.json").exists()
    first = {path: path.stat().st_mtime_ns for path in (last.parent / last.name.removesuffix("-seed1")).rglob("*")}

    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout.splitlines() == [
        f"runs/synthetic/{last.name.removesuffix('-seed1')}",
        f"runs/synthetic/{last.name}",
    ]
    lines = done.stderr.splitlines()
    first_run = f"runs/synthetic/{last.name.removesuffix('-seed1')}"
    assert f"[1/3] {first_run}: finished before, nothing to do; --overwrite" in done.stderr
    assert lines[-3] == "sweep grid: 2 of 3 runs are finished"
    assert lines[-2].startswith("failed: model train paper --steps 200 ") and "--geometry box: " in lines[-2]
    assert "no box proxies; make them with `proxies make`" in lines[-2]
    assert lines[-1].startswith("error: sweep grid: 1 of 3 runs failed")
    assert {path: path.stat().st_mtime_ns for path in first} == first

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    flags = [word for key, value in size.items() for word in (f"--{key}", str(value))]
    assert call(monkeypatch, "train", *flags, "--seed", "1", "--out", "byhand", "--label", last.name) == 0
    torch.set_num_threads(threads)
    made, by_hand = (
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (last, tmp_path / "byhand")
    )
    assert made == by_hand


def test_each_device_runs_one_process_at_a_time_and_none_is_idle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = read_experiment(write(tmp_path, f'[[runs]]\nmethod = "paper"\nseed = {list(range(12))}'))
    busy: Counter[str] = Counter()
    lock, all_three = threading.Lock(), threading.Barrier(3, timeout=120)

    def train(
        arguments: tuple[str, ...], place: str, environment: dict[str, str], children: object
    ) -> sweep.Failure | None:
        (device,) = environment.values()
        with lock:
            busy[device] += 1
            assert busy[device] == 1
        all_three.wait()  # Breaks, and with it the sweep, unless every device is busy.
        with lock:
            busy[device] -= 1
        return sweep.Failure(command=arguments[-1], reason=place) if int(arguments[-1]) % 5 == 3 else None

    monkeypatch.setattr(sweep, "_train_in_child", train)
    failures = sweep.run_experiment(experiment, devices=("0", "GPU-b", "2"))
    assert [(failure.command, failure.reason) for failure in failures] == [("3", "[4/12]"), ("8", "[9/12]")]
    assert set(busy) == {"0", "GPU-b", "2"}


def test_jobs_on_the_cpu_run_side_by_side_and_share_its_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = read_experiment(write(tmp_path, f'[[runs]]\nmethod = "paper"\nseed = {list(range(4))}'))
    monkeypatch.setattr(sweep, "num_cores", lambda: 5)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    met = threading.Barrier(2, timeout=120)
    environments: list[dict[str, str]] = []

    def train(_: object, place: str, environment: dict[str, str], children: object) -> None:
        environments.append(environment)
        met.wait()  # Breaks, and with it the sweep, unless two are there at once.

    monkeypatch.setattr(sweep, "_train_in_child", train)
    assert sweep.run_experiment(experiment, devices=sweep.find_devices(2)) == ()
    assert environments == [{"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"}] * 4
    # More jobs than cores leave each a thread; a single one keeps what its user has set.
    assert set(sweep.share_of_cores(6).values()) == {"1"} and sweep.share_of_cores(1) == {}
    with pytest.raises(HyalineError, match="jobs: is 0; expected at least 1"):
        sweep.find_devices(0)


@pytest.mark.parametrize(
    ("visible", "count", "jobs", "devices"),
    [
        (None, 0, 1, (None,)),
        (None, 0, 2, (None, None)),
        (None, 2, 1, ("0", "1")),
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
    assert sweep.find_devices(jobs) == devices


def test_a_sweep_in_jobs_has_one_for_each_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[Mapping[str, Sequence[str]]] = []

    def run_in_jobs(program: str, jobs: Mapping[str, Sequence[str]], place: Path, launch: object) -> dict[str, str]:
        assert (program, place) == ("model", Path("runs/jobs"))
        sent.append(jobs)
        return {list(jobs)[-1]: "it was cancelled"}

    monkeypatch.setattr("model.run.sweep.run_in_jobs", run_in_jobs)
    block = '[[runs]]\ndataset = "synthetic"\nmethod = "paper"\nsteps = 3\nseed = [0, 1]\n'
    write_synthetic_dataset(tmp_path / "data" / "synthetic", resolution=8, train_views=1)
    answer = commands.call(f"model sweep {write(tmp_path, block)} --launcher slurm")
    assert [shlex.join(["model", *words]) for words in sent[0].values()] == list(sent[0])
    assert answer.status == 1 and "1 of 2 runs are finished" in answer.err and "it was cancelled" in answer.err
