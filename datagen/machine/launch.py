"""Commands as jobs, on a cluster or on this machine: submits them, waits, and reports which failed and why.

submitit hands the jobs to Slurm, or to this machine. Its files and the jobs' logs lie in a folder of their own
(DATASET-jobs/, or runs/jobs/), which may be deleted when all has ended.
"""

import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from datagen.disk.errors import HyalineError, UsageError
from datagen.disk.names import real_path
from datagen.disk.ownership import FolderKind, begin, holding, is_ours
from datagen.disk.storage import seal_bytes
from datagen.terminal.command import say

if TYPE_CHECKING:
    import submitit

JOBS = FolderKind(what="jobs", head="jobs.json", way_out="move that elsewhere, or choose another --out")
"""What submitit and the jobs write there has names of its own."""

POLL_S = 0.5
QUEUE_EVERY_S = 10.0
"""Slurm is asked for the jobs' states this often."""
ANSWERS = 2
"""So many answers in a row must say that a job is over: one that Slurm is about to requeue may look failed for once."""
ANSWERS_WITHOUT_RESULT = 6
"""The same for a job that should have left a result, which may take a while to be seen from another machine."""
WEEK_MIN = 7 * 24 * 60
SLURM = ("sbatch", "srun", "squeue", "scancel")

OVER = {
    "BOOT_FAIL": "its machine did not start",
    "CANCELLED": "it was cancelled",
    "COMPLETED": "",
    "DEADLINE": "it reached its deadline",
    "FAILED": "",
    "GONE": "",
    "NODE_FAIL": "its machine failed",
    "OUT_OF_MEMORY": "it ran out of memory; type SBATCH_MEM_PER_CPU=8G in front of the command to ask for more",
    "PREEMPTED": "it was stopped for another job",
    "REVOKED": "another cluster took it",
    "TIMEOUT": "it reached its time limit (--slurm-time {minutes}); what it finished is kept",
}
"""Slurm's states of jobs that are over, and GONE for those it has forgotten, with what they say about a failure."""


@dataclass(frozen=True, kw_only=True)
class LaunchChoices:
    """Run in jobs on a Slurm cluster."""

    launcher: Literal["slurm", "local"] | None = None
    """slurm: submit Slurm jobs from a machine that shares the folder, wait for them, and report failures. local (only
    for builds): run all jobs on this machine. Needs the extra `cluster`. Logs: DATASET-jobs/ or runs/jobs/."""
    slurm_partition: str | None = None
    """Slurm partition. Default: the cluster's. Other options of sbatch are read from its variables, such as
    SBATCH_ACCOUNT."""
    slurm_time: int | None = None
    """Time limit of each job in minutes; finished work is kept. Default: 30 plus three times the estimated time, which
    grows with pixels, samples and steps."""
    slurm_cpus: int | None = None
    """CPUs of each job. Default: as many as --workers, or 4 for training."""
    slurm_gpus: int = 0
    """GPUs of each job."""

    def __post_init__(self) -> None:
        for item in fields(self):
            flag, value = f"--{item.name.replace('_', '-')}", getattr(self, item.name)
            if item.name == "launcher" or value == item.default:
                continue
            if isinstance(value, int) and value < 1:
                raise UsageError(f"{flag}: is {value}; expected at least 1")
            if self.launcher is None:
                raise UsageError(f"{flag}: goes with --launcher; give that, too, or leave it out")
            if self.launcher == "local" and item.name.startswith("slurm_"):
                raise UsageError(f"{flag}: goes with --launcher slurm; leave it out")


@dataclass(frozen=True, kw_only=True)
class JobFailure:
    """A job that did not finish."""

    name: str
    log: Path
    reason: str
    """Its last error message, or how it ended."""


def estimate_minutes(cpu_s: float, cpus: int) -> int:
    """The time limit of a job, from the CPU time that its work takes on a slow processor."""
    return 30 + math.ceil(3 * cpu_s / cpus / 60)


def run_in_jobs(
    program: str,
    jobs: Mapping[str, Sequence[str]],
    folder: Path,
    launch: LaunchChoices,
    *,
    cpus: int,
    cpu_s: float,
) -> tuple[JobFailure, ...]:
    """Runs `PROGRAM WORDS` as a job for each of `jobs`, and returns when all have ended.

    Args:
        jobs: words of the jobs' commands, by the names that messages call the jobs.
        folder: for submitit's files and the jobs' logs.
        cpus: of each job, unless `launch` says so.
        cpu_s: CPU time that the longest of them takes on a slow processor.

    Returns:
        Those that did not finish.

    Raises:
        HyalineError: the cluster took no job.
    """
    import submitit
    from submitit.core.utils import FailedJobError, FailedSubmissionError

    for name in SLURM if launch.launcher == "slurm" else ():
        if shutil.which(name) is None:
            raise HyalineError(f"--launcher slurm: no {name} on this machine; run this on one that submits Slurm jobs")
    folder, cpus = real_path(folder), launch.slurm_cpus or cpus
    minutes = launch.slurm_time or estimate_minutes(cpu_s, cpus)
    executor = submitit.AutoExecutor(folder=folder, cluster=launch.launcher)
    executor.update_parameters(**_parameters(program, launch, cpus, minutes))
    with holding(folder, JOBS):
        if not is_ours(folder, JOBS):
            begin(folder, JOBS, seal_bytes({"version": 1, "program": program}), {})
    size = f"; each: CPUs {cpus}, minutes {minutes}" if launch.launcher == "slurm" else ""
    say(f"{folder}: logs of the jobs that are submitted ({launch.launcher}, jobs {len(jobs)}{size})")
    try:
        with executor.batch():
            sent = [executor.submit(run_command, program, list(words), str(Path.cwd())) for words in jobs.values()]
    except (FailedJobError, FailedSubmissionError) as error:
        raise HyalineError(f"--launcher {launch.launcher}: the cluster took no job ({error})") from error
    return _wait(dict(zip(jobs, sent, strict=True)), minutes, is_slurm=launch.launcher == "slurm")


def raise_failures(where: str, failures: Sequence[JobFailure], total: int) -> None:
    """Reports jobs that did not finish, and raises a HyalineError if there are any."""
    for failure in failures:
        say(f"failed: {failure.name}: {failure.reason}; log: {failure.log}")
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
    # submitit has Slurm send SIGUSR2 to all processes of a job shortly before its limit, which would end them. At the
    # limit, and before it requeues a job, Slurm sends SIGTERM; then our commands save their work.
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)
    return subprocess.run([*own_command(program), *words], cwd=folder, check=False).returncode


def _parameters(program: str, launch: LaunchChoices, cpus: int, minutes: int) -> dict[str, object]:
    """Parameters for submitit, whose local jobs otherwise end after two minutes."""
    if launch.launcher == "local":
        return {"timeout_min": WEEK_MIN}
    parameters: dict[str, object] = {
        "name": program,
        "timeout_min": minutes,
        "cpus_per_task": cpus,
        # Since 22.05 srun does not take over sbatch's number, and would bind the command to a single CPU.
        "slurm_srun_args": [f"--cpus-per-task={cpus}"],
        "slurm_signal_delay_s": 1,
        "slurm_additional_parameters": {"requeue": True},
    }
    if launch.slurm_gpus:
        parameters["gpus_per_node"] = launch.slurm_gpus
    if launch.slurm_partition is not None:
        parameters["slurm_partition"] = launch.slurm_partition
    return parameters


def _wait(jobs: "dict[str, submitit.Job[int]]", minutes: int, *, is_slurm: bool) -> tuple[JobFailure, ...]:
    """Waits until all jobs are over, and tells of each; if it is stopped itself, it stops them."""
    waiting, failures = dict(jobs), []
    states: dict[str, str] = {}
    over = Counter[str]()  # The number of answers in a row by which a job is over.
    asked_at, queue = -math.inf, ""
    try:
        while waiting:
            time.sleep(POLL_S)
            answer = None
            if not is_slurm:
                answer = {job.job_id: ("COMPLETED" if job.done() else "RUNNING", "") for job in waiting.values()}
            elif time.monotonic() - asked_at >= QUEUE_EVERY_S:
                answer, asked_at = _ask_slurm(), time.monotonic()
            for name, job in list(waiting.items()):
                if answer is not None:
                    before, states[name] = states.get(name), answer.get(job.job_id, ("GONE", ""))[0]
                    over[name] = over[name] + 1 if states[name] in OVER else 0
                    if before not in (None, "PENDING") and states[name] == "PENDING":
                        say(f"{name}: requeued by Slurm; will continue when its turn comes (job {job.job_id})")
                status = _status(job) if is_slurm or states[name] in OVER else None
                needed = ANSWERS if status is not None or OVER.get(states.get(name, "")) else ANSWERS_WITHOUT_RESULT
                if status != 0 and over[name] < needed:
                    continue
                del waiting[name]
                if status != 0:
                    reason = _why_failed(job, status, states[name], minutes)
                    failures.append(JobFailure(name=name, log=job.paths.stderr, reason=reason))
                say(f"{name}: {'done' if status == 0 else 'failed'} (job {job.job_id}; {len(waiting)} left)")
            if waiting and is_slurm and answer and queue != (queue := _summary(answer, list(waiting.values()))):
                say(f"slurm: {queue}")
    except BaseException:
        # Ctrl-C: what runs is told to stop; what it has committed stays.
        for job in waiting.values():
            job.cancel(check=False)
        raise
    return tuple(failures)


def _ask_slurm() -> dict[str, tuple[str, str]] | None:
    """The state of each of our jobs, and why it waits, by its id; also of those that ended some minutes ago.

    `squeue` knows this on every cluster, `sacct` where accounting is kept. None: Slurm did not answer.
    """
    words = ["squeue", f"--user={os.getuid()}", "--states=all", "--array", "--noheader", "--format=%i|%T|%r"]
    try:
        answer = subprocess.run(words, capture_output=True, text=True, errors="replace", timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if answer.returncode != 0:
        return None
    rows = [line.strip().split("|") for line in answer.stdout.splitlines()]
    return {row[0]: (row[1], row[2]) for row in rows if len(row) == 3}


def _summary(answer: Mapping[str, tuple[str, str]], jobs: "Sequence[submitit.Job[int]]") -> str:
    """How many jobs are in which state, such as `1 running, 2 pending (Priority)`."""
    found = [answer[job.job_id] for job in jobs if job.job_id in answer]
    counts = Counter(f"pending ({why})" if state == "PENDING" else state.lower() for state, why in found)
    return ", ".join(f"{count} {state}" for state, count in counts.items())


def _status(job: "submitit.Job[int]") -> int | None:
    """The exit status of the command that ran in a job, or ran last if it was requeued; None: not known yet."""
    from submitit.core.utils import pickle_load

    try:
        outcome, status = pickle_load(job.paths.result_pickle)
    except (FileNotFoundError, EOFError):
        return None
    return status if outcome == "success" else 1  # The command did not start; why is in the log.


def _why_failed(job: "submitit.Job[int]", status: int | None, state: str, minutes: int) -> str:
    """Why the command in a job failed, or why it did not end."""
    if OVER[state]:
        return OVER[state].format(minutes=minutes)
    if status is not None and status < 0:
        return f"ended by signal {-status}"
    lines = job.paths.stderr.read_text(errors="replace").splitlines() if job.paths.stderr.is_file() else []
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    return errors[-1] if errors else "ended without a result" if status is None else f"exit status {status}"
