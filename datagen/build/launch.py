"""Builds on a cluster: submits the parts of a build as jobs, waits, and reports failures with their logs.

A job is `datagen build ... --shard i/n`; submitit hands it to Slurm, or to this machine. Its files lie beside the
dataset, in DATASET-jobs/, and may be deleted when all has ended.
"""

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.build.choices import BuildChoices, LaunchChoices, SizeChoices
from datagen.disk.errors import HyalineError
from datagen.disk.names import real_path
from datagen.disk.ownership import FolderKind, begin, holding, is_ours
from datagen.disk.storage import seal_bytes
from datagen.scene.import_choices import ImportChoices
from datagen.terminal.command import say
from datagen.terminal.parsing import flag_words

if TYPE_CHECKING:
    import submitit


JOBS = FolderKind(what="jobs of a build", head="jobs.json", way_out="move that elsewhere, or choose another --out")
"""What submitit and the jobs write there, DATASET-jobs/, has names of its own."""

POLL_S = 0.5
WEEK_MIN = 7 * 24 * 60


@dataclass(frozen=True, kw_only=True)
class JobFailure:
    """A job that failed."""

    shard: str
    log: Path
    reason: str
    """Its last error message, or how it ended."""


def build_in_jobs(
    scene: str, root: Path, choices: BuildChoices, size: SizeChoices, launch: LaunchChoices, imports: ImportChoices
) -> None:
    """Builds all parts of a dataset at `root` in jobs, and returns when all have succeeded.

    Raises:
        HyalineError: the cluster took no job, or a job failed.
    """
    import submitit
    from submitit.core.utils import FailedJobError, FailedSubmissionError

    folder = real_path(root.parent / f"{root.name}-jobs")
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=launch.launcher)
    except RuntimeError as error:
        raise HyalineError(f"--launcher {launch.launcher}: not found on this machine ({error})") from error
    executor.update_parameters(**_parameters(launch, choices.workers))
    with holding(folder, JOBS):
        if not is_ours(folder, JOBS):
            begin(folder, JOBS, seal_bytes({"version": 1, "dataset": root.name}), {})
    kinds = ((choices, BuildChoices()), (size, SizeChoices()), (imports, ImportChoices()))
    words = ["build", scene, *(word for record, usual in kinds for word in flag_words(record, usual))]
    names = [f"{number}/{launch.shards}" for number in range(1, launch.shards + 1)]
    say(f"{root}: sends off {launch.shards} jobs ({launch.launcher}); their logs: {folder}")
    try:
        with executor.batch():
            jobs = [executor.submit(build_part, [*words, "--shard", name], str(Path.cwd())) for name in names]
    except (FailedJobError, FailedSubmissionError) as error:
        raise HyalineError(f"--launcher {launch.launcher}: the cluster took no job ({error})") from error
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
            f"{root}: {len(failures)} of {launch.shards} jobs failed, as the lines above say; "
            "mend that and run the same command again, which goes on"
        )


def build_part(words: list[str], folder: str) -> int:
    """The exit status of `datagen WORDS` in a folder; it writes to the job's log. Runs in a job."""
    program = (
        f"from datagen.machine.processes import die_with; die_with({os.getpid()}); from datagen.cli import main; main()"
    )
    return subprocess.run([sys.executable, "-P", "-c", program, *words], cwd=folder, check=False).returncode


def _parameters(launch: LaunchChoices, workers: int) -> dict[str, str | int]:
    """Parameters for submitit, whose local jobs otherwise end after two minutes."""
    if launch.launcher == "local":
        return {"timeout_min": WEEK_MIN}
    parameters: dict[str, str | int] = {
        "name": "datagen",
        "timeout_min": launch.slurm_time,
        "cpus_per_task": launch.slurm_cpus or workers,
    }
    if launch.slurm_gpus:
        parameters["gpus_per_node"] = launch.slurm_gpus
    if launch.slurm_partition is not None:
        parameters["slurm_partition"] = launch.slurm_partition
    return parameters


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
