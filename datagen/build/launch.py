"""Builds on a cluster: sends the parts of a build off as jobs, waits, and says which failed and where it tells.

A job is `datagen build ... --shard i/n`, with the words of the command that sends it off; submitit hands it to Slurm,
or to this machine. Its files lie beside the dataset, in DATASET-jobs/, and may be deleted when all has ended.
"""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from datagen.disk.errors import HyalineError
from datagen.disk.names import real_path
from datagen.disk.ownership import FolderKind, begin, holding, is_ours
from datagen.disk.storage import seal_bytes
from datagen.terminal.command import say

if TYPE_CHECKING:
    import submitit


JOBS = FolderKind(what="jobs of a build", head="jobs.json", way_out="move that elsewhere, or choose another --out")
"""What submitit and the jobs write there, DATASET-jobs/, has names of its own."""

POLL_S = 0.5
WEEK_MIN = 7 * 24 * 60


@dataclass(frozen=True, kw_only=True)
class LaunchChoices:
    """How a build is sent off in parts. Each field is a flag of `datagen build` with one value."""

    launcher: Literal["slurm", "local"] | None = None
    """Build in --shards jobs, wait for them, and check the whole: slurm (on a cluster, from a machine that sees the
    same folder) or local (all at once on this machine). Needs submitit. Logs: beside the dataset, in DATASET-jobs/."""
    shards: int = 4
    """--launcher: number of jobs."""
    slurm_partition: str | None = None
    """--launcher slurm: partition; the cluster's default unless given."""
    slurm_time: int = 240
    """--launcher slurm: time limit of each job in minutes; what a job has finished by then is kept."""
    slurm_cpus: int | None = None
    """--launcher slurm: CPUs of each job; as many as --workers unless given."""
    slurm_gpus: int = 0
    """--launcher slurm: GPUs of each job."""

    def __post_init__(self) -> None:
        for name in ("shards", "slurm_time", "slurm_cpus"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise HyalineError(f"{name}: is {value}; expected at least 1")
        for item in fields(self):
            if item.name == "launcher" or getattr(self, item.name) == item.default:
                continue
            if self.launcher is None:
                raise HyalineError(f"--{item.name.replace('_', '-')}: goes with --launcher; give slurm or local")
            if self.launcher == "local" and item.name.startswith("slurm_"):
                raise HyalineError(f"--{item.name.replace('_', '-')}: goes with --launcher slurm; leave it out")


@dataclass(frozen=True, kw_only=True)
class JobFailure:
    """A job that did not make its part."""

    shard: str
    log: Path
    reason: str
    """The last error that it told, or how it ended."""


def launch(arguments: Sequence[str], root: Path, choices: LaunchChoices, *, workers: int) -> None:
    """Builds all parts of a dataset in jobs, and returns when all have ended well.

    Args:
        arguments: the words of the command `datagen` that builds it, from `build` on.
        root: the dataset.

    Raises:
        HyalineError: the cluster took no job, or a job failed.
    """
    import submitit
    from submitit.core.utils import FailedJobError, FailedSubmissionError

    folder = real_path(root.parent / f"{root.name}-jobs")
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=choices.launcher)
    except RuntimeError as error:
        raise HyalineError(f"--launcher {choices.launcher}: there is none on this machine ({error})") from error
    executor.update_parameters(**_parameters(choices, workers))
    with holding(folder, JOBS):
        if not is_ours(folder, JOBS):
            begin(folder, JOBS, seal_bytes({"version": 1, "dataset": root.name}), {})
    words = _without_launch(arguments)
    names = [f"{number}/{choices.shards}" for number in range(1, choices.shards + 1)]
    say(f"{root}: sends off {choices.shards} jobs ({choices.launcher}); their logs: {folder}")
    try:
        with executor.batch():
            jobs = [executor.submit(build_part, [*words, "--shard", name], str(Path.cwd())) for name in names]
    except (FailedJobError, FailedSubmissionError) as error:
        raise HyalineError(f"--launcher {choices.launcher}: the cluster took no job ({error})") from error
    failures: list[JobFailure] = []
    waiting = dict(zip(names, jobs, strict=True))
    try:
        while waiting:
            time.sleep(POLL_S)
            for name in [name for name, job in waiting.items() if job.done()]:
                job = waiting.pop(name)
                reason = _why_failed(job)
                if reason is not None:
                    failures.append(JobFailure(shard=name, log=job.paths.stderr, reason=reason))
                say(f"part {name}: {'done' if reason is None else 'failed'} (job {job.job_id}; {len(waiting)} left)")
    except BaseException:
        # Ctrl-C: what runs is told to stop; what it has committed stays.
        for job in waiting.values():
            job.cancel()
        raise
    for failure in failures:
        say(f"failed: part {failure.shard}: {failure.reason}; log: {failure.log}")
    if failures:
        raise HyalineError(
            f"{root}: {len(failures)} of {choices.shards} jobs failed, as the lines above say; "
            "mend that and run the same command again, which goes on"
        )


def build_part(words: list[str], folder: str) -> int:
    """The exit status of `datagen WORDS` in a folder; it writes to the job's log. Runs in a job."""
    program = (
        f"from datagen.machine.processes import die_with; die_with({os.getpid()}); from datagen.cli import main; main()"
    )
    return subprocess.run([sys.executable, "-P", "-c", program, *words], cwd=folder, check=False).returncode


def _parameters(choices: LaunchChoices, workers: int) -> dict[str, str | int]:
    """What submitit is told; its local jobs end after two minutes unless told otherwise."""
    if choices.launcher == "local":
        return {"timeout_min": WEEK_MIN}
    parameters: dict[str, str | int] = {
        "name": "datagen",
        "timeout_min": choices.slurm_time,
        "cpus_per_task": choices.slurm_cpus or workers,
    }
    if choices.slurm_gpus:
        parameters["gpus_per_node"] = choices.slurm_gpus
    if choices.slurm_partition is not None:
        parameters["slurm_partition"] = choices.slurm_partition
    return parameters


def _without_launch(arguments: Sequence[str]) -> list[str]:
    """The arguments without the flags of `LaunchChoices` and their values."""
    flags = {f"--{item.name}" for item in fields(LaunchChoices)}
    kept, is_value = [], False
    for argument in arguments:
        flag, equals, _ = argument.partition("=")
        is_flag = flag.startswith("--") and flag.replace("-", "_").replace("__", "--", 1) in flags
        if not is_flag and not is_value:
            kept.append(argument)
        is_value = is_flag and not equals
    return kept


def _why_failed(job: "submitit.Job[int]") -> str | None:
    """Why a job that has ended failed; None when it did not."""
    from submitit.core.utils import UncompletedJobError

    try:
        status = job.result()
    except UncompletedJobError:
        ended = f"ended without a result ({job.state.lower()})"
    else:
        if status == 0:
            return None
        ended = f"ended by signal {-status}" if status < 0 else f"exit status {status}"
    lines = job.paths.stderr.read_text(errors="replace").splitlines() if job.paths.stderr.is_file() else []
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    return errors[-1] if errors else ended
