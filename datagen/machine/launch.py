"""Commands as jobs, on a Slurm cluster or on this machine, by submitit: submits them, waits, and reports failures.

submitit's files and the jobs' logs lie in a folder of their own, DATASET-jobs/ or runs/jobs/, which may be deleted.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.storage import real_path
from datagen.terminal.command import say


def run_in_jobs(
    program: str,
    jobs: Mapping[str, Sequence[str]],
    folder: Path,
    launcher: str | None,
    parameters: Mapping[str, object],
) -> dict[str, str]:
    """Runs `PROGRAM WORDS` as a job for each of `jobs`, and returns when all have ended.

    Args:
        jobs: words of the jobs' commands, by the names that messages call the jobs.
        folder: for submitit's files and the jobs' logs.
        launcher: slurm or local.
        parameters: what submitit asks the cluster for.

    Returns:
        Why jobs failed, by their names.

    Raises:
        HyalineError: the cluster took no job.
    """
    import submitit

    folder = real_path(folder)
    say(f"{folder}: logs of {len(jobs)} jobs ({launcher})")
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=launcher)
        executor.update_parameters(name=program, **parameters)
        with executor.batch():
            sent = [executor.submit(run_command, program, list(words), str(Path.cwd())) for words in jobs.values()]
    except RuntimeError as error:  # No sbatch on this machine; or Slurm rejects the jobs.
        raise HyalineError(f"--launcher {launcher}: the cluster took no job ({error})") from error
    failures = {}
    try:
        for name, job in zip(jobs, sent, strict=True):
            try:
                log = (job.stderr() or "") if job.result() else None
                errors = [line[7:] for line in (log or "").splitlines() if line.startswith("error: ")]
                reason = "" if log is None else (errors or ["no error was printed"])[-1]
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


def raise_failures(where: str, failures: Mapping[str, str], total: int) -> None:
    """Reports jobs that did not finish, and raises a HyalineError if there are any."""
    for name, reason in failures.items():
        say(f"failed: {name}: {reason}", is_error=True)
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
