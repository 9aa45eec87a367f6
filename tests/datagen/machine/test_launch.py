"""Tests of commands as jobs: on this machine, and what is handed to Slurm, with a stand-in for its sbatch."""

import shutil
from pathlib import Path

import pytest

from datagen.builder.choices import LaunchChoices
from datagen.disk.errors import HyalineError
from datagen.machine.launch import run_in_jobs


@pytest.mark.slow
def test_each_job_runs_a_command_and_a_failure_has_its_reason_and_log(tmp_path: Path) -> None:
    jobs = {"good": ["scenes"], "bad": ["verify", "nothing"]}
    failures = run_in_jobs("datagen", jobs, tmp_path / "jobs", "local", LaunchChoices(launcher="local").parameters())
    assert set(failures) == {"bad"}
    reason, _, log = failures["bad"].rpartition("; log: ")
    assert reason.startswith("data/nothing: no dataset; make one with") and reason in Path(log).read_text()


def test_jobs_for_slurm_ask_for_what_was_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("srun", "sacct"):
        (programs / name).write_text("#!/bin/sh\n")
    (programs / "sbatch").write_text(
        f"#!/bin/sh\n{shutil.which('cp')} $1 {tmp_path}/script; echo no partition >&2; exit 1\n"
    )
    for path in programs.iterdir():
        path.chmod(0o755)
    monkeypatch.setenv("PATH", str(programs))
    chosen = LaunchChoices(launcher="slurm", slurm_time=30, slurm_cpus=2, slurm_gpus=1).parameters()
    with pytest.raises(HyalineError, match=r"^--launcher slurm: the cluster took no job .*no partition"):
        run_in_jobs("datagen", {"one": ["scenes"], "two": ["scenes"]}, tmp_path / "jobs", "slurm", chosen)
    options = ("--array=0-1%2", "--time=30", "--cpus-per-task=2", "--gpus-per-node=1")
    assert all(f"#SBATCH {option}\n" in (tmp_path / "script").read_text() for option in options)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(HyalineError, match=r"^--launcher slurm: the cluster took no job"):
        run_in_jobs("datagen", {"one": ["scenes"]}, tmp_path / "jobs", "slurm", chosen)
