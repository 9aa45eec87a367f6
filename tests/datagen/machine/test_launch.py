"""Tests of jobs with stand-ins for Slurm's programs; tests/slurm has those with a real one."""

from pathlib import Path

import pytest

from datagen.disk.errors import HyalineError
from datagen.machine import launch
from datagen.machine.launch import LaunchChoices, estimate_minutes, run_in_jobs

# The n-th call of squeue gives the n-th of the answers, where `run` runs the job and `fail` is no answer at all.
SLURM = {
    "sbatch": """#!/bin/sh
cp "$1" {folder}/script
echo "Submitted batch job 5"
""",
    "srun": """#!/bin/sh
while [ "${{1#--}}" != "$1" ]; do
  case "$1" in --output|--error) shift;; esac
  shift
done
exec "$@" 2>>{folder}/jobs/5_0_log.err
""",
    "squeue": """#!/bin/sh
echo >>{folder}/calls
state=$(sed -n "$(wc -l <{folder}/calls)p" {folder}/answers)
case "$state" in
  fail) exit 1;;
  run) state=COMPLETED; SLURM_JOB_ID=5 SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_NODEID=0 SLURM_JOB_NUM_NODES=1 \\
    SLURM_NTASKS=1 SLURM_JOB_NODELIST=here sh {folder}/script >/dev/null 2>&1;;
esac
[ -z "$state" ] || echo "5|$state|None"
""",
    "scancel": "#!/bin/sh\n",
}


@pytest.mark.parametrize(
    ("answers", "words", "reason", "said"),
    [
        (["RUNNING", "NODE_FAIL", "PENDING", "RUNNING", "run"], ["--version"], None, "one: requeued by Slurm"),
        (["RUNNING", "FAILED", "COMPLETING", "PENDING", "run"], ["--version"], None, "one: requeued by Slurm"),
        (["run"] * 2, ["verify", "nowhere"], "data/nowhere: no dataset", "one: failed (job 5; 0 left)"),
        (["TIMEOUT"] * 2, [], "it reached its time limit (--slurm-time 7); what it finished is kept", "1 timeout"),
        (["RUNNING", "fail", "OUT_OF_MEMORY", "fail", "OUT_OF_MEMORY"], [], "it ran out of memory; type", "1 running"),
        (["RUNNING", *[""] * 6], [], "ended without a result", "1 running"),
    ],
)
def test_a_job_has_failed_when_slurm_says_so_twice(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    answers: list[str],
    words: list[str],
    reason: str | None,
    said: str,
) -> None:
    for name, script in SLURM.items():
        (tmp_path / name).write_text(script.format(folder=tmp_path))
        (tmp_path / name).chmod(0o755)
    (tmp_path / "answers").write_text("\n".join(answers) + "\n")
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.setattr(launch, "POLL_S", 0.01)
    monkeypatch.setattr(launch, "QUEUE_EVERY_S", 0.01)
    choices = LaunchChoices(launcher="slurm", slurm_time=7)
    failures = run_in_jobs("datagen", {"one": words}, tmp_path / "jobs", choices, cpus=3, cpu_s=1)
    assert said in capsys.readouterr().err
    assert len((tmp_path / "calls").read_text()) == len(answers)
    if reason is None:
        assert failures == ()
    else:
        (failure,) = failures
        assert failure.reason.startswith(reason) and failure.log == tmp_path / "jobs" / "5_0_log.err"
    script = (tmp_path / "script").read_text()
    for line in ("#SBATCH --time=7", "#SBATCH --cpus-per-task=3", "#SBATCH --requeue", "--cpus-per-task=3 "):
        assert line in script


@pytest.mark.parametrize("missing", ["sbatch", "squeue"])
def test_a_machine_that_submits_no_jobs_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    for name in set(SLURM) - {missing}:
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(HyalineError, match=f"^--launcher slurm: no {missing} on this machine; run this on one that"):
        run_in_jobs("datagen", {}, tmp_path / "jobs", LaunchChoices(launcher="slurm"), cpus=1, cpu_s=1)
    assert not (tmp_path / "jobs").exists()


def test_a_limit_is_three_times_the_estimate_and_half_an_hour() -> None:
    assert [estimate_minutes(0, 1), estimate_minutes(1200, 1), estimate_minutes(1200, 4)] == [30, 90, 45]
