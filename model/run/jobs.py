"""Training as Slurm jobs: a single run, or the unfinished ones of a sweep, each an independent job."""

from collections.abc import Sequence
from pathlib import Path

from datagen.disk.errors import HyalineError, UsageError
from datagen.disk.ownership import is_ours
from datagen.machine.launch import JobFailure, LaunchChoices, raise_failures, run_in_jobs
from datagen.terminal.command import say
from datagen.terminal.parsing import flag_words
from model.run.experiments import Experiment
from model.run.run_folder import FOLDER, check_trained_on, is_all_drawn
from model.run.sweep import Failure, command_line, run_commands
from model.run.train_flags import Asked, configure, folder_name, parse_train
from model.settings.run_flags import RUNS, RunFlags

JOBS = RUNS / "jobs"
CPUS = 4
"""Default CPUs per job."""
TRAINED_S, DRAWN_S = 120e-6, 300e-6
"""CPU time of a training pixel in a step and of a predicted pixel, by `light-path` on a slow processor."""
FEW = 64
"""A batch of fewer is not of pixels but of views."""


def train_in_job(method: str, asked: Asked) -> Path:
    """The folder of a run, which a job has trained; a finished run stays as it is.

    Raises:
        HyalineError: a choice that cannot be, the cluster took no job, or the job failed.
    """
    _check(asked.cluster)
    if asked.run.overwrite:
        raise UsageError("--overwrite: does not go with --launcher, whose jobs resume runs; delete the run first")
    out, cpu_s = _plan(method, asked)
    if cpu_s is None:
        say(f"{out}: finished before, nothing to do")
        return out
    words = words_of(method, asked)
    raise_failures(str(out), _run({command_line(words): words}, asked.cluster, cpu_s), 1)
    return out


def train_experiment_in_jobs(experiment: Experiment, cluster: LaunchChoices) -> tuple[Failure, ...]:
    """Trains every run that is not finished in a job of its own.

    Returns:
        The runs that failed, in the experiment's order.
    """
    _check(cluster)
    run_commands(experiment, experiment.needs)
    jobs: dict[str, Sequence[str]] = {}
    longest, reasons = 0.0, dict[str, str]()
    for words in experiment.runs:
        try:
            _, cpu_s = _plan(words[0], parse_train(words[0], words[1:]))
        except HyalineError as error:
            reasons[command_line(words)] = str(error)
            continue
        if cpu_s is not None:
            jobs[command_line(words)] = words
            longest = max(longest, cpu_s)
    if finished := len(experiment.runs) - len(jobs) - len(reasons):
        say(f"sweep {experiment.name}: {finished} runs were finished before")
    failures = _run(jobs, cluster, longest) if jobs else ()
    reasons |= {failure.name: f"{failure.reason}; log: {failure.log}" for failure in failures}
    lines = map(command_line, experiment.runs)
    return tuple(Failure(command=line, reason=reasons[line]) for line in lines if line in reasons)


def _check(cluster: LaunchChoices) -> None:
    if cluster.launcher == "local":
        raise UsageError("--launcher local: is for builds; leave it out, training uses this machine anyway")
    if cluster.slurm_gpus > 1:
        raise UsageError(f"--slurm-gpus: is {cluster.slurm_gpus}; a run trains on one")


def _plan(method: str, asked: Asked) -> tuple[Path, float | None]:
    """A run's folder, and the CPU time that it takes on a slow processor; None if it is finished."""
    config, dataset = configure(method, asked)
    out = asked.run.out or RUNS / dataset.name / folder_name(method, asked)
    if is_ours(out, FOLDER):
        check_trained_on(out, config, dataset)
        if is_all_drawn(out, dataset):
            return out, None
    pixels = dataset.config.resolution.pixels
    batch = config.batch * (pixels if config.batch < FEW else 1)
    views = sum(count for split, count in dataset.num_views.items() if split != "train")
    return out, TRAINED_S * config.steps * batch + DRAWN_S * views * pixels


def words_of(method: str, asked: Asked) -> tuple[str, ...]:
    """The words after `model train` that ask for the same, without a job."""
    usual = asked.method.usual(asked.run.geometry)
    pairs = ((asked.run, RunFlags()), (asked.method, usual), (asked.optimisation, usual.optimisation()))
    dataset = () if asked.dataset is None else (asked.dataset,)
    return (method, *dataset, *(word for record, normal in pairs for word in flag_words(record, normal)))


def _run(jobs: dict[str, Sequence[str]], cluster: LaunchChoices, cpu_s: float) -> tuple[JobFailure, ...]:
    words = {name: ["train", *words] for name, words in jobs.items()}
    return run_in_jobs("model", words, JOBS, cluster, cpus=CPUS, cpu_s=cpu_s)
