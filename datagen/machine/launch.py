"""Commands as jobs, on a Slurm cluster or on this machine, by submitit: submits them, waits, and reports failures.

submitit's files and the jobs' logs lie in a folder of their own (DATASET-jobs/, or runs/jobs/), which may be deleted
when all has ended.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from datagen.disk.errors import HyalineError, UsageError
from datagen.disk.storage import real_path
from datagen.terminal.command import say

if TYPE_CHECKING:
    import submitit

LOCAL_MIN = 7 * 24 * 60
"""Time limit of jobs on this machine; submitit's own is two minutes."""


@dataclass(frozen=True, kw_only=True)
class LaunchChoices:
    """Run in jobs on a Slurm cluster. Options of sbatch are read from its variables, such as SBATCH_PARTITION."""

    launcher: Literal["slurm", "local"] | None = None
    """slurm: submit Slurm jobs from a machine that shares the folder, wait for them, and report failures. local: run
    all jobs on this machine at once. Needs the extra `cluster`. Logs: DATASET-jobs/ or runs/jobs/."""
    slurm_time: int = 24 * 60
    """Time limit of each job in minutes; finished work is kept."""
    slurm_cpus: int = 4
    """CPUs of each job."""
    slurm_gpus: int = 0
    """GPUs of each job."""

    def __post_init__(self) -> None:
        changed = [item.name for item in fields(self) if getattr(self, item.name) != item.default]
        if self.launcher is None and changed:
            flags = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
            raise UsageError(f"{flags}: need --launcher; give that, too, or leave them out")
        if min(self.slurm_time, self.slurm_cpus) < 1 or self.slurm_gpus < 0:
            raise UsageError("--slurm-time, --slurm-cpus: expected at least 1, and --slurm-gpus at least 0")

    def parameters(self) -> dict[str, object]:
        """What submitit asks the cluster for."""
        if self.launcher == "local":
            return {"timeout_min": LOCAL_MIN}
        return {
            "timeout_min": self.slurm_time,
            "cpus_per_task": self.slurm_cpus,
            # Since 22.05 srun does not take over sbatch's number, and would bind the command to a single CPU.
            "slurm_srun_args": [f"--cpus-per-task={self.slurm_cpus}"],
            **({"gpus_per_node": self.slurm_gpus} if self.slurm_gpus else {}),
        }


def run_in_jobs(program: str, jobs: Mapping[str, Sequence[str]], folder: Path, launch: LaunchChoices) -> dict[str, str]:
    """Runs `PROGRAM WORDS` as a job for each of `jobs`, and returns when all have ended.

    Args:
        jobs: words of the jobs' commands, by the names that messages call the jobs.
        folder: for submitit's files and the jobs' logs.

    Returns:
        Why jobs failed, by their names.

    Raises:
        HyalineError: the cluster took no job.
    """
    import submitit

    folder = real_path(folder)
    say(f"{folder}: logs of {len(jobs)} jobs ({launch.launcher})")
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=launch.launcher)
        executor.update_parameters(name=program, **launch.parameters())
        with executor.batch():
            sent = [executor.submit(run_command, program, list(words), str(Path.cwd())) for words in jobs.values()]
    except RuntimeError as error:  # No sbatch on this machine; or Slurm rejects the jobs.
        raise HyalineError(f"--launcher {launch.launcher}: the cluster took no job ({error})") from error
    failures = {}
    try:
        for name, job in zip(jobs, sent, strict=True):
            try:
                reason = _error_of(job) if job.result() else ""
            except Exception:  # submitit raises plain exceptions, too.
                reason = f"ended without a result ({job.state})"
            if reason:
                failures[name] = f"{reason}; log: {job.paths.stderr}"
            say(f"{name}: {'failed' if reason else 'done'} (job {job.job_id})")
    except BaseException:
        for job in sent:  # Ctrl-C: what runs is told to stop; what it has committed stays.
            job.cancel(check=False)
        raise
    return failures


def _error_of(job: "submitit.Job[int]") -> str:
    """The last error in a job's log."""
    errors = [line[7:] for line in (job.stderr() or "").splitlines() if line.startswith("error: ")]
    return errors[-1] if errors else "no error was printed"


def raise_failures(where: str, failures: Mapping[str, str], total: int) -> None:
    """Reports jobs that did not finish, and raises a HyalineError if there are any."""
    for name, reason in failures.items():
        say(f"failed: {name}: {reason}")
    if failures:
        raise HyalineError(
            f"{where}: {len(failures)} of {total} jobs failed (see above); "
            "run the same command again to continue where they stopped"
        )


def own_command(program: str) -> list[str]:
    """What starts `datagen` or `model` so that it ends when this process is killed: else it would go on writing."""
    code = f"from datagen.machine.processes import die_with; die_with({os.getpid()}); from {program}.cli import main"
    return [sys.executable, "-P", "-c", f"{code}; main()"]


def run_command(program: str, words: list[str], folder: str) -> int:
    """The exit status of `PROGRAM WORDS` in a folder; it writes to the job's log. Runs in a job."""
    # submitit has Slurm send SIGUSR2 to all processes of a job before its limit, which would end them. At the limit,
    # and before it requeues a job, Slurm sends SIGTERM; then our commands save their work.
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)
    return subprocess.run([*own_command(program), *words], cwd=folder, check=False).returncode
