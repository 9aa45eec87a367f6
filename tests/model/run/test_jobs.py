"""Tests of `model train` and `model sweep` as Slurm jobs; tests/slurm has those with a real Slurm."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
from support.commands import call
from support.synthetic import write_synthetic_dataset

from datagen.machine.launch import JobFailure, LaunchChoices
from model.run import jobs
from model.run.train_flags import parse_train

RUN = "synthetic --steps 3 --batch 64 --texture-size 16 --hidden 32"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a dataset."""
    write_synthetic_dataset(tmp_path / "data" / "synthetic")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("line", "status", "error"),
    [
        ("model train paper --slurm-time 9", 2, "--slurm-time: goes with --launcher; give that, too, or leave it out"),
        ("model train paper --launcher slurm --slurm-cpus 0", 2, "--slurm-cpus: is 0; expected at least 1"),
        ("model train paper --launcher slrm", 2, "--launcher: is 'slrm'; did you mean slurm?"),
        ("model train paper --launcher local", 2, "--launcher local: is for builds; leave it out"),
        ("model train paper --launcher slurm --slurm-gpus 2", 2, "--slurm-gpus: is 2; a run trains on one"),
        ("model train paper --launcher slurm --overwrite", 2, "--overwrite: does not go with --launcher"),
        (f"model train paper {RUN} --geometry box --launcher slurm", 1, "no box proxies; make them with"),
        (f"model train paper {RUN} --launcher slurm", 1, "--launcher slurm: no sbatch on this machine"),
        ("model sweep table1 --jobs 2 --launcher slurm", 2, "--jobs: is for runs on this machine; leave it out"),
        ("model sweep table1 --launcher local", 2, "--launcher local: is for builds; leave it out"),
        ("model sweep table1 --slurm-partition gpu", 2, "--slurm-partition: goes with --launcher"),
    ],
)
def test_what_cannot_be_a_job_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, line: str, status: int, error: str
) -> None:
    monkeypatch.setenv("PATH", str(folder))
    answer = call(line)
    assert answer.status == status
    assert error in answer.error and answer.err.count("error: ") == 1
    assert not (folder / "runs").exists()


def test_a_sweep_sends_only_runs_that_can_be_and_are_not_finished(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[tuple[dict[str, list[str]], LaunchChoices, float]] = []

    def run_in_jobs(
        program: str,
        words: Mapping[str, Sequence[str]],
        place: Path,
        launch: LaunchChoices,
        *,
        cpus: int,
        cpu_s: float,
    ) -> tuple[JobFailure, ...]:
        assert (program, place) == ("model", Path("runs/jobs"))
        sent.append(({name: list(line) for name, line in words.items()}, launch, cpu_s))
        for line in list(words.values())[:-1]:
            assert call(shlex.join(["model", *line])).status == 0
        return (JobFailure(name=list(words)[-1], log=Path("there"), reason="it was cancelled"),)

    monkeypatch.setattr(jobs, "run_in_jobs", run_in_jobs)
    keys = {"dataset": "synthetic", "method": "paper", "steps": 3, "batch": 64, "texture-size": 16, "hidden": 32}
    block = "[[runs]]\n" + "".join(f"{key} = {value!r}\n" for key, value in keys.items())
    Path("grid.toml").write_text(f'{block}seed = [0, 1]\n{block}geometry = "box"\n')
    line = "model sweep grid.toml --launcher slurm --slurm-time 9"
    answer = call(line)
    assert answer.status == 1
    asked, launch, cpu_s = sent[0]
    assert [shlex.join(["model", *words]) for words in asked.values()] == list(asked)
    assert [name.split()[-1] for name in asked] == ["0", "1"]
    assert launch == LaunchChoices(launcher="slurm", slurm_time=9) and cpu_s > 3 * 64 * jobs.TRAINED_S
    lines = answer.err.splitlines()
    assert "sweep grid: 1 of 3 runs are finished" in lines
    assert lines[-3].endswith("--seed 1: it was cancelled; log: there")
    assert lines[-2].startswith("failed: model train paper ") and "no box proxies; make them with" in lines[-2]

    answer = call(line)
    assert "sweep grid: 1 runs were finished before" in answer.err
    assert list(sent[1][0]) == [list(asked)[1]]


def test_the_estimate_grows_with_steps_and_pixels(folder: Path) -> None:
    def steps_s(method: str, batch: int, steps: int) -> float:
        words = ("synthetic", "--batch", str(batch))
        asked = [parse_train(method, (*words, "--steps", str(number))) for number in (steps, 2 * steps)]
        fewer, more = (jobs._plan(method, one)[1] for one in asked)
        assert more is not None and fewer is not None
        return more - fewer

    assert steps_s("paper", 512, 1000) == pytest.approx(1000 * 512 * jobs.TRAINED_S)
    assert steps_s("deepvoxels", 2, 1000) == pytest.approx(1000 * 2 * 32**2 * jobs.TRAINED_S), "a batch of views"
